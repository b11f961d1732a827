//! A page in a real browser.
//!
//! Needs Chromium in the path or in `CHROMIUM`. Without it a test says so and passes, except where `CI` is
//! set: there it fails.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]
#![allow(clippy::print_stdout, reason = "a skipped test says so")]

use std::path::{Path, PathBuf};
use std::process::Command;

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
pub(crate) fn dom(html: &str) -> Option<String> {
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

/// What keeps a reader out of the page, at the widths of a small phone, a phone, a small window and a desk: each a
/// sentence. `None`
/// without a browser. What is looked for stands in `audit.js`.
pub(crate) fn faults(html: &str) -> Option<Vec<String>> {
    let frames: String = [320, 390, 1000, 1280]
        .map(|width| {
            format!(
                "<iframe width=\"{width}\" height=\"900\" data-width=\"{width}\" srcdoc=\"{}\"></iframe>",
                html.replace('&', "&amp;").replace('"', "&quot;")
            )
        })
        .concat();
    let outer = format!(
        "<!DOCTYPE html><html><body>{frames}<ul></ul><script>{}\n\
         addEventListener('load', () => {{\
           for (const frame of document.querySelectorAll('iframe')) {{\
             for (const fault of audit(frame.contentDocument)) {{\
               const line = document.createElement('li');\
               line.textContent = frame.dataset.width + ' px: ' + fault;\
               document.querySelector('ul').append(line);\
             }}\
             frame.remove();\
           }}\
           document.documentElement.dataset.audited = '1';\
         }});</script></body></html>",
        include_str!("audit.js")
    );
    let dom = dom(&outer)?;
    assert!(root(&dom).contains("data-audited=\"1\""), "the audit broke off: {}", root(&dom));
    let lines = dom.split("<li>").skip(1).map(|rest| rest.split("</li>").next().unwrap().to_owned());
    Some(lines.collect())
}

fn run(browser: &Path, dir: &Path, file: &Path) -> String {
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
        .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .arg(format!("--user-data-dir={}", dir.join("profile").display()))
        .args(["--hide-scrollbars", "--window-size=1200,900", "--dump-dom"])
        .arg(format!("file://{}", file.display()))
        .output()
        .unwrap_or_else(|error| panic!("cannot run {}: {error}", browser.display()));
    let dom = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success() && !dom.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
    dom
}

/// The opening tag of the document.
pub(crate) fn root(dom: &str) -> &str {
    let start = dom.find("<html").unwrap();
    &dom[start..start + dom[start..].find('>').unwrap()]
}
