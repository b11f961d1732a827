//! An identification's `report.json` against its schema, its sentences, and its page.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use greybox_report::contract::{Finding, Interval, Severity};
use greybox_report::identified::{OrderValue, schema};
use greybox_report::page::IdentifyPage;
use greybox_report::{IdentifyReport, sentence};
use serde_json::{Value, json};

#[path = "common/browser.rs"]
mod browser;
#[path = "common/schema.rs"]
mod documents;
#[path = "../examples/sample/mod.rs"]
mod sample;

/// The keys of the design, and those that greybox adds.
fn promised() -> Value {
    json!({
        "equations": {"theta": {
            "input": "v",
            "expression": "m*theta'' + k2c1*theta^2*theta' - kp*delay(theta, tau) = v",
            "terms": [
                {"expression": "theta''", "powers": {"theta''": 1}, "parameter": "m", "value": 2.0,
                 "ci95": [1.99, 2.01], "unit": "V s^2"},
                {"expression": "theta^2*theta'", "powers": {"theta": 2, "theta'": 1}, "parameter": "k2c1",
                 "value": -0.2, "ci95": [-0.21, -0.19], "unit": "V s", "inclusion": 1.0},
                {"expression": "delay(theta, tau)", "value": -3.0, "ci95": [-4.0, -2.0], "unit": "V"}],
            "doubtful": [{"expression": "theta^3", "chosen": false, "inclusion": 0.23},
                         {"expression": "theta^2*theta'", "chosen": true, "inclusion": 0.61}]}},
        "variables": {"theta": {"role": "state", "channel_unit": "deg", "unit": "rad"},
                      "v": {"role": "input", "channel_unit": "V", "unit": "V"}},
        "order": {"chosen": 3, "criterion": "aic", "by_order": [[1, 832.0], [2, 832.0], [3, -10786.0]]},
        "delay": {"theta": {"value": 0.2, "ci95": [0.199, 0.201], "unit": "s", "bound": 0.0005, "gain": 3.0,
                            "gain_ci95": [2.0, 4.0], "gain_unit": "V", "correlation": -0.98}},
        "fit": {"train": {"nominal": {}, "calibrated": {}, "improved": {"theta": {"nrmse": 0.02}}},
                "holdout": {"nominal": {}, "calibrated": {}, "improved": {"theta": {"nrmse": 0.021}}},
                "holdout_source": "recordings held out: test.csv"},
        "noise_floor": {"theta": 0.015},
        "misfit": {"theta": 1.02},
        "inputs": {"v": {"hold_given": "", "hold_best": "linear"}}
    })
}

fn report() -> IdentifyReport {
    let mut report = IdentifyReport::from_json(&promised().to_string()).unwrap();
    for delay in report.delay.values_mut() {
        delay.warning = sentence::identified::delay_warning(delay);
    }
    report.summary = sentence::identified::summary(&report);
    report
}

/// A page with the signals of the sample, the identified model in the place of the improved one.
fn page() -> IdentifyPage {
    let sample = sample::page();
    let mut page = IdentifyPage {
        title: "Equations of theta".to_owned(),
        report: report(),
        recordings: sample.recordings,
        residuals: sample.residuals,
        model_text: sample.models.improved,
    };
    for channel in page.recordings.iter_mut().flat_map(|r| &mut r.channels) {
        channel.nominal.clear();
        channel.calibrated.clear();
    }
    for residual in &mut page.residuals {
        residual.before.clear();
        residual.spectrum.as_mut().unwrap().before.clear();
    }
    page
}

fn assert_valid(report: &IdentifyReport) -> Value {
    documents::assert_valid(&report.to_json().unwrap(), &schema())
}

#[test]
fn the_checked_in_schema_is_current() {
    documents::assert_current("identify.schema.json", &schema());
}

/// Renaming a field must fail here.
#[test]
fn the_promised_keys_are_there_and_come_back_unchanged() {
    let report = report();
    let written = assert_valid(&report);
    for (key, value) in promised().as_object().unwrap() {
        match key.as_str() {
            // These carry further keys; below are those that were promised.
            "delay" => assert_eq!(written["delay"]["theta"]["ci95"], json!([0.199, 0.201])),
            "fit" => assert_eq!(written["fit"]["holdout"]["improved"], value["holdout"]["improved"]),
            _ => assert_eq!(written[key], *value, "{key}"),
        }
    }
    assert_eq!(written["fit"]["train"]["nominal"], json!({}));
    assert_eq!(IdentifyReport::from_json(&report.to_json().unwrap()).unwrap(), report);
}

#[test]
fn numbers_that_are_not_finite_become_null() {
    let mut page = page();
    let report = &mut page.report;
    report.misfit.insert("theta".to_owned(), f64::NAN);
    report.noise_floor.insert("theta".to_owned(), f64::INFINITY);
    report.order.by_order.push(OrderValue { order: 4, value: f64::NAN });
    let equation = &mut report.equations["theta"];
    equation.terms[0].value = f64::NAN;
    equation.terms[1].ci95 = Some(Interval::new(f64::NEG_INFINITY, f64::NAN));
    equation.doubtful[0].inclusion = f64::NAN;
    let delay = &mut report.delay["theta"];
    (delay.value, delay.gain) = (f64::NAN, f64::INFINITY);
    report.fit.holdout.improved["theta"].nrmse = f64::NAN;
    let json = assert_valid(report);
    assert_eq!(json["order"]["by_order"][3], json!([4, null]));
    assert!(json["misfit"]["theta"].is_null() && json["delay"]["theta"]["value"].is_null());
    let back = IdentifyReport::from_json(&report.to_json().unwrap()).unwrap();
    assert!(back.order.by_order[3].value.is_nan());
    assert!(sentence::identified::summary(report).iter().any(|s| s.contains("diverges")));
    report.summary.clear();
    let html = page.to_html().unwrap();
    assert!(!html.contains("NaN") && !html.contains("inf %"));
}

#[test]
fn the_sentences_say_equation_prediction_doubts_and_delay() {
    let summary = report().summary;
    assert_eq!(summary[0], "Equation of theta: 2.000 θ″ − 0.2000 θ²·θ′ − 3.000 θ(t − 0.2000 s) = v.");
    assert_eq!(
        summary[1],
        "Running freely, the model follows the held-out data with an error of 2.1 % (noise alone 1.5 %)."
    );
    assert!(summary[2].starts_with("Kept, but not surely there: θ²·θ′ (61 %)"), "{}", summary[2]);
    assert!(summary[3].starts_with("Left out, but not ruled out: θ³ (23 %)"), "{}", summary[3]);
    assert!(summary[4].contains("is delayed by") && summary[4].contains("3.0 ± 1.0"), "{}", summary[4]);
    assert!(summary[5].starts_with("Delay and gain move together (correlation −0.980)"), "{}", summary[5]);
    assert_eq!(summary.len(), 6, "{summary:#?}");
}

#[test]
fn what_the_equation_leaves_is_said_when_it_is_not_noise() {
    let mut report = report();
    report.misfit.insert("theta".to_owned(), 4.2);
    let summary = sentence::identified::summary(&report);
    assert!(summary.iter().any(|s| s.contains("θ is 4.2 times the noise")), "{summary:#?}");
    assert!(!self::report().summary.iter().any(|s| s.contains("times the noise")));
}

#[test]
fn a_delay_is_doubted_only_where_its_numbers_are_doubtful() {
    let mut delay = report().delay["theta"].clone();
    delay.correlation = Some(0.5);
    assert_eq!(sentence::identified::delay_warning(&delay), None);
    delay.gain_ci95 = Some(Interval::new(-1.0, 7.0));
    assert!(sentence::identified::delay_warning(&delay).unwrap().contains("gain holds zero"));
    delay.gain_ci95 = None;
    assert_eq!(sentence::identified::delay_warning(&delay), None, "a gain that was given");
    delay.ci95 = Some(Interval::new(-0.1, 0.5));
    assert!(sentence::identified::delay_warning(&delay).unwrap().starts_with("The interval of the delay"));
}

/// The report of an equation whose input has this dead time and interval, looked for up to half a second.
fn late(value: f64, ci95: Value) -> IdentifyReport {
    let mut promised = promised();
    promised["dead_time"] = json!({"v": {"parameter": "tau_v", "value": value, "ci95": ci95, "unit": "s", "bound": 0.0004, "longest": 0.5}});
    let mut report = IdentifyReport::from_json(&promised.to_string()).unwrap();
    for (input, dead_time) in &mut report.dead_time {
        dead_time.warning = sentence::identified::dead_time_warning(input, dead_time);
    }
    report.summary = sentence::identified::summary(&report);
    report
}

#[test]
fn a_dead_time_stands_in_the_equation_the_sentences_and_the_page() {
    let report = late(0.073, json!([0.072, 0.074]));
    let written = assert_valid(&report);
    assert_eq!(written["dead_time"]["v"]["ci95"], json!([0.072, 0.074]));
    assert!(report.summary[0].ends_with(" = v(t − 0.07300 s)."), "{}", report.summary[0]);
    assert_eq!(report.summary.last().unwrap(), "The dead time of v is (0.0730 ± 0.0010) s.");
    let html = IdentifyPage { report, ..page() }.to_html().unwrap();
    assert!(html.contains("<h3>Input <var>v</var></h3>") && html.contains("Longest looked for"), "{html}");
}

#[test]
fn a_dead_time_that_may_be_none_or_ended_at_the_longest_is_said() {
    let none = late(0.0004, json!([0.0, 0.0016]));
    let last = none.summary.last().unwrap();
    assert!(last.contains("do not tell it from none") && last.contains("at most 0.0016 s"), "{last}");
    let none = late(0.0, json!([0.0, 0.0016]));
    assert!(none.summary[0].ends_with(" = v."), "{}", none.summary[0]);
    let longest = late(0.5, Value::Null);
    let last = longest.summary.last().unwrap();
    assert!(last.contains("ended on the longest looked for, 0.500 s"), "{last}");
    assert!(last.contains("--dead-time v=SECONDS"), "{last}");
    assert!(late(0.1, json!([0.09, 0.11])).dead_time["v"].warning.is_none());
}

#[test]
fn the_page_says_what_a_reader_must_know() {
    let html = page().to_html().unwrap();
    let mut last = 0;
    for section in
        ["equations", "terms", "delay", "fit", "signals", "residual", "order", "model", "health", "reading"]
    {
        let at = html.find(&format!("<section id=\"{section}\"")).unwrap_or_else(|| panic!("no {section}"));
        assert!(at > last, "{section} comes too early");
        last = at;
    }
    for link in html.split("href=\"#").skip(1) {
        let target = link.split('"').next().unwrap();
        assert!(html.contains(&format!("id=\"{target}\"")), "{target}");
    }
    for text in [
        "greybox identification",
        "<var>θ</var>",
        "1.990 … 2.010",
        "Delay and gain move together",
        "3 (chosen)",
        "−10786",
        "<td>not stated</td>",
        "Held-out data was never used",
        ">Identified<small>",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    for absent in ["Nominal", "Calibrated", "calibrated</em>", "greybox diagnosis"] {
        assert!(!html.contains(absent), "{absent:?} has no place on this page");
    }
}

#[test]
fn text_from_a_file_stays_text() {
    const EVIL: &str =
        "</script><script>alert(1)</script><img src=x onerror=alert(2)>\" onload='alert(3)' & \u{2028}";
    let evil = || EVIL.to_owned();
    let mut page = page();
    page.title = evil();
    page.model_text = evil();
    let report = &mut page.report;
    report.summary = vec![evil(), evil()];
    report.order.criterion = evil();
    let mut equation = report.equations["theta"].clone();
    (equation.input, equation.expression) = (Some(evil()), evil());
    for term in &mut equation.terms {
        (term.expression, term.parameter, term.unit) = (evil(), Some(evil()), Some(evil()));
    }
    equation.doubtful[0].expression = evil();
    report.equations.insert(evil(), equation);
    let mut delay = report.delay["theta"].clone();
    (delay.unit, delay.gain_unit, delay.warning) = (evil(), Some(evil()), Some(evil()));
    report.delay.insert(evil(), delay);
    let mut variable = report.variables["theta"].clone();
    (variable.unit, variable.channel_unit) = (evil(), evil());
    report.variables.insert(evil(), variable);
    report.findings.push(Finding {
        severity: Severity::Error,
        code: evil(),
        recording: Some(evil()),
        channel: Some(evil()),
        message: evil(),
        help: Some(evil()),
    });
    for recording in &mut page.recordings {
        recording.name = evil();
        (recording.channels[0].name, recording.channels[0].unit) = (evil(), evil());
    }
    for summary in [true, false] {
        if !summary {
            page.report.summary.clear();
        }
        let html = page.to_html().unwrap();
        assert_eq!(html.matches("<script").count(), 3, "only the page's own scripts");
        let own = &html[..html.find("<script type=\"application/json\"").unwrap()];
        assert!(!own.contains("<img"), "an image slipped in");
        assert!(!html.contains("\" onload="), "an attribute was closed");
    }
}

#[test]
fn an_empty_page_is_a_page() {
    let mut page = page();
    page.recordings.clear();
    page.residuals.clear();
    page.model_text.clear();
    let report = &mut page.report;
    report.equations.clear();
    report.variables.clear();
    report.delay.clear();
    report.order.by_order.clear();
    report.fit = Default::default();
    report.inputs.clear();
    report.summary.clear();
    let html = page.to_html().unwrap();
    assert!(html.contains("Nothing to remark") && !html.contains("id=\"delay\""));
}

#[test]
fn the_browser_draws_all_plots() {
    // As on the page of a diagnosis: two recordings with two channels and one input, two residuals.
    let Some(dom) = browser::dom(&page().to_html().unwrap()) else { return };
    let root = browser::root(&dom);
    assert!(root.contains("data-plots=\"10\"") && root.contains("data-errors=\"0\""), "{root}");
    assert_eq!(dom.matches("<canvas").count(), 10);
}

#[test]
fn the_page_keeps_nobody_out() {
    let Some(faults) = browser::faults(&page().to_html().unwrap()) else { return };
    assert!(faults.is_empty(), "{faults:#?}");
}
