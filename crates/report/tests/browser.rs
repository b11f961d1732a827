//! The page in a real browser: the script runs, draws every plot and reaches for nothing.
//!
//! Needs Chromium in the path or in `CHROMIUM`. Without it the test says so and passes, except where `CI` is
//! set: there it fails.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]
#![allow(clippy::print_stdout, reason = "a skipped test says so")]

use std::path::{Path, PathBuf};
use std::process::Command;

#[path = "../examples/sample/mod.rs"]
mod sample;

fn chromium() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("CHROMIUM").filter(|path| !path.is_empty()) {
        return Some(PathBuf::from(path));
    }
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path)
        .flat_map(|dir| ["chromium", "chromium-browser", "google-chrome"].map(|name| dir.join(name)))
        .find(|candidate| candidate.is_file())
}

/// The document after its scripts have run, or `None` without a browser.
fn dom(html: &str) -> Option<String> {
    let Some(browser) = chromium() else {
        let ci = std::env::var_os("CI").is_some_and(|value| value == "true" || value == "1");
        assert!(!ci, "no Chromium in the path or in CHROMIUM, and CI must not skip this test");
        println!("skipped: no Chromium in the path or in CHROMIUM");
        return None;
    };
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("report.html");
    std::fs::write(&file, html).unwrap();
    Some(run(&browser, dir.path(), &file))
}

fn run(browser: &Path, dir: &Path, file: &Path) -> String {
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
        .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .arg(format!("--user-data-dir={}", dir.join("profile").display()))
        .args(["--window-size=1200,900", "--dump-dom"])
        .arg(format!("file://{}", file.display()))
        .output()
        .unwrap_or_else(|error| panic!("cannot run {}: {error}", browser.display()));
    let dom = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success() && !dom.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
    dom
}

/// The opening tag of the document.
fn root(dom: &str) -> &str {
    let start = dom.find("<html").unwrap();
    &dom[start..start + dom[start..].find('>').unwrap()]
}

#[test]
fn the_page_draws_all_plots_and_loads_nothing() {
    let page = sample::page();
    // Two channels and one input in each of two recordings; two residuals with a time plot and a spectrum.
    let plots = 10;
    let Some(dom) = dom(&page.to_html().unwrap()) else { return };
    assert!(root(&dom).contains(&format!("data-plots=\"{plots}\"")), "{}", root(&dom));
    assert!(root(&dom).contains("data-errors=\"0\""), "{}", root(&dom));
    assert_eq!(dom.matches("<canvas").count(), plots);
    // Each canvas has a size in the layout.
    assert!(!dom.contains("<canvas width=\"0\""));
    let text = dom.replace('\u{a0}', " ").replace("&nbsp;", " ");
    for needle in [
        "Coulomb friction is missing in the hub equation; fc = 0.0652 ± 0.0018 N m; it acts when |θ′| &lt; 0.6",
        "<th scope=\"row\">θ</th>",
        "<td class=\"num strong\">0.0652 ± 0.0018</td>",
        "<td class=\"num strong\">0.0121 ± 0.0004</td>",
        "class=\"drawing\"",
        "<td class=\"u-value\">",
    ] {
        assert!(text.contains(needle), "the document lacks {needle:?}");
    }
    for attribute in ["src=\"", "href=\""] {
        for value in dom.split(&format!(" {attribute}")).skip(1).map(|rest| rest.split('"').next().unwrap()) {
            assert!(value.starts_with('#'), "{attribute}{value} leaves the page");
        }
    }
}

#[test]
fn hostile_names_do_nothing_in_the_browser() {
    let mut page = sample::page();
    let evil = "</script><script>document.documentElement.dataset.owned='1'</script>\
                <img src=x onerror=\"document.documentElement.dataset.owned='2'\">";
    page.title = evil.to_owned();
    page.report.summary = vec![evil.to_owned()];
    for recording in &mut page.recordings {
        recording.name = evil.to_owned();
        recording.channels[0].name = evil.to_owned();
        recording.inputs[0].name = evil.to_owned();
    }
    page.models.improved.push_str(evil);
    let Some(dom) = dom(&page.to_html().unwrap()) else { return };
    assert!(!root(&dom).contains("data-owned"), "{}", root(&dom));
    assert!(root(&dom).contains("data-errors=\"0\""), "{}", root(&dom));
    assert!(root(&dom).contains("data-plots=\"10\""), "{}", root(&dom));
}

#[test]
fn flat_and_missing_series_are_drawn_without_error() {
    let mut page = sample::page();
    let n = page.recordings[0].t.len();
    page.recordings[0].channels[0].measured = vec![3.0; n];
    page.recordings[0].channels[0].nominal = vec![f64::NAN; n];
    page.recordings[0].channels[1].calibrated = vec![1e300; n];
    page.recordings[0].channels[1].improved.truncate(10);
    page.recordings[1].t.truncate(1);
    let residual = &mut page.residuals[0];
    residual.before.fill(0.0);
    residual.noise_sigma = f64::NAN;
    let spectrum = residual.spectrum.as_mut().unwrap();
    spectrum.before.fill(0.0);
    spectrum.noise.clear();
    spectrum.after.fill(1.0);
    let Some(dom) = dom(&page.to_html().unwrap()) else { return };
    assert!(root(&dom).contains("data-errors=\"0\""), "{}", root(&dom));
    assert!(root(&dom).contains("data-plots=\"10\""), "{}", root(&dom));
}
