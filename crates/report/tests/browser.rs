//! The page in a real browser: the script runs, draws every plot and reaches for nothing.

use run::{dom, faults, root};

#[path = "common/browser.rs"]
mod run;
#[path = "../examples/sample/mod.rs"]
mod sample;

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

#[test]
fn the_page_keeps_nobody_out() {
    let Some(faults) = faults(&sample::page().to_html().unwrap()) else { return };
    assert!(faults.is_empty(), "{faults:#?}");
}

/// Long names, many mechanisms and long equations: what is wide scrolls in its own box, the page never does.
#[test]
fn a_wide_page_does_not_scroll_sideways() {
    let mut page = sample::page();
    let long = "a_recording_of_the_second_axis_at_the_third_operating_point_".repeat(4);
    let terms: Vec<String> = (0..40).map(|i| format!("coefficient_{i}*sin({i}*theta')")).collect();
    let law = terms.join(" + ");
    page.title = long.clone();
    page.report.model.file = format!("{long}.toml");
    for (i, recording) in page.recordings.iter_mut().enumerate() {
        recording.name = format!("{long}{i}.csv");
        recording.channels[0].name = format!("{long}channel");
        recording.inputs[0].name = format!("{long}input");
    }
    page.models.improved.push_str(&format!("wide = \"{law} = 0\"\n"));
    let report = &mut page.report;
    report.fit.recordings = report.fit.recordings.values().map(|fit| (long.clone(), fit.clone())).collect();
    let mut mechanism = report.mechanisms[0].clone();
    mechanism.expression = law.clone();
    for alternative in &mut mechanism.alternatives {
        alternative.kind = "a_kind_with_a_name_that_is_much_longer_than_any_other".repeat(3);
        alternative.expression = Some(law.clone());
        alternative.separate = Some(long.clone());
    }
    let estimate = mechanism.parameters["fc"].clone();
    mechanism.parameters.insert(format!("{long}parameter"), estimate);
    report.mechanisms.extend(std::iter::repeat_n(mechanism, 6));
    report.summary = vec![long];
    let Some(faults) = faults(&page.to_html().unwrap()) else { return };
    let wide: Vec<&String> = faults.iter().filter(|fault| fault.contains("px wide")).collect();
    assert!(wide.is_empty(), "{wide:#?}");
}

/// What the audit is worth: it finds each of these.
#[test]
fn the_audit_finds_what_keeps_a_reader_out() {
    let page = "<!DOCTYPE html><html><body><main><h1 id=\"a\">Title</h1><h3 id=\"a\">Too deep</h3>\
                <p style=\"color:#999\">pale</p><div style=\"width:2000px\">wide</div><a href=\"#b\">nowhere</a>\
                <section aria-labelledby=\"c\"></section>\
                <div style=\"overflow:auto\"><div style=\"width:1999px\">box</div></div>\
                <table><tr><th></th><td>1</td></tr></table><svg></svg><canvas></canvas><b role=\"button\">x</b>\
                </main></body></html>";
    let Some(faults) = faults(page) else { return };
    for part in [
        "px wide, the window 320",
        "scrolls, but not by keyboard",
        "no language",
        "0 of header",
        "0 of nav[aria-label]",
        "does not skip",
        "a heading is skipped before",
        "twice: ",
        "named by nothing",
        "leads nowhere",
        "no caption",
        "no scope or empty",
        "a drawing without words",
        "a plot without words",
        "no switch",
        "contrast 2.85",
    ] {
        assert!(faults.iter().any(|fault| fault.contains(part)), "{part}: {faults:#?}");
    }
}
