//! `report.json` against its schema, and the schema against its checked-in copy.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use greybox_report::contract::{
    Fit, FitSet, Interval, Location, Names, Ordered, SCHEMA, Score, Subset, Verdict, schema,
};
use greybox_report::{Report, sentence};

#[path = "common/schema.rs"]
mod documents;
#[path = "../examples/sample/mod.rs"]
mod sample;

fn assert_valid(report: &Report) -> serde_json::Value {
    documents::assert_valid(&report.to_json().unwrap(), &schema())
}

#[test]
fn the_checked_in_schema_is_current() {
    documents::assert_current("report.schema.json", &schema());
}

#[test]
fn a_report_satisfies_the_schema_and_comes_back_unchanged() {
    let report = sample::page().report;
    let json = assert_valid(&report);
    assert_eq!(json["verdict"], "missing_physics");
    assert_eq!(json["mechanisms"][0]["equation"], "hub");
    assert_eq!(json["mechanisms"][0]["parameters"]["fc"]["ci95"].as_array().unwrap().len(), 2);
    assert_eq!(json["remainder"]["location"], serde_json::json!({ "windows_s": {}, "region": {} }));
    assert!(json["fit"]["holdout"]["improved"]["theta"]["nrmse"].as_f64().unwrap() < 0.1);
    // Shortest round-trip formatting of numbers: what is read back is what was written.
    assert_eq!(Report::from_json(&report.to_json().unwrap()).unwrap(), report);
}

/// The key of `help` had another name.
#[test]
fn findings_of_earlier_versions_are_read() {
    let finding =
        r#"{"severity": "warning", "code": "clipping", "message": "clipped", "mend": "turn it down"}"#;
    let read: greybox_report::contract::Finding = serde_json::from_str(finding).unwrap();
    assert_eq!(read.help.as_deref(), Some("turn it down"));
}

/// So had that of a subset's residual; reports before the second schema state none.
#[test]
fn subsets_of_earlier_versions_are_read() {
    let read: Subset = serde_json::from_str(r#"{"mechanisms": [0], "left": 0.25}"#).unwrap();
    assert_eq!(read, Subset { mechanisms: vec![0], residual_share: 0.25 });
}

#[test]
fn a_report_of_a_later_schema_is_refused() {
    let mut report = sample::page().report;
    assert_eq!(report.greybox.schema, SCHEMA);
    report.greybox.schema = SCHEMA + 1;
    let error = Report::from_json(&report.to_json().unwrap()).unwrap_err().to_string();
    assert!(error.contains(&format!("schema {}", SCHEMA + 1)), "{error}");
    report.greybox.schema = 0;
    assert_eq!(Report::from_json(&report.to_json().unwrap()).unwrap(), report);
}

/// The promised keys, in the words of the design; renaming a field must fail here.
#[test]
fn the_promised_keys_are_there() {
    let promised = serde_json::json!({
        "verdict": "missing_physics",
        "mechanisms": [
            {"kind": "coulomb_friction", "equation": ["hub", "link"], "expression": "fc*sign(theta')",
             "parameters": {"fc": {"value": 0.11, "ci95": [0.10, 0.12], "unit": "N m"}},
             "share_explained": 0.81, "confidence": 0.99,
             "alternatives": [{"kind": "stribeck_friction", "confidence": 0.2, "equivalent": true}],
             "location": {"equation": "hub", "windows_s": {"train.csv": [[1.2, 1.9]]},
                          "region": {"theta'": [-0.2, null]}, "band_hz": [0.1, 2.0]}}
        ],
        "remainder": {"significant": false, "location": {}, "share_of_residual": 0.03},
        "parameters": {"J": {"nominal": 0.0021, "value": 0.0024, "ci95": [0.0023, 0.0025]}},
        "fit": {"train": {"nominal": {"theta": {"nrmse": 0.31}}, "calibrated": {"theta": {"nrmse": 0.22}},
                          "improved": {"theta": {"nrmse": 0.02}}},
                "holdout": {"nominal": {}, "calibrated": {}, "improved": {}}},
        "noise_floor": {"theta": 0.015}
    });
    let report = Report::from_json(&promised.to_string()).unwrap();
    assert_eq!(report.verdict, Verdict::MissingPhysics);
    let written = assert_valid(&report);
    assert_contains(&written, &promised, "report");
}

/// Everything in `expected` stands in `actual`, which may hold more keys.
fn assert_contains(actual: &serde_json::Value, expected: &serde_json::Value, place: &str) {
    use serde_json::Value;
    match (actual, expected) {
        (Value::Object(actual), Value::Object(expected)) => {
            for (key, value) in expected {
                let found = actual.get(key).unwrap_or_else(|| panic!("{place}.{key} is missing"));
                assert_contains(found, value, &format!("{place}.{key}"));
            }
        }
        (Value::Array(actual), Value::Array(expected)) => {
            assert_eq!(actual.len(), expected.len(), "{place}");
            for (index, (a, e)) in actual.iter().zip(expected).enumerate() {
                assert_contains(a, e, &format!("{place}[{index}]"));
            }
        }
        _ => assert_eq!(actual, expected, "{place}"),
    }
}

#[test]
fn numbers_that_are_not_finite_become_null() {
    let mut report = sample::page().report;
    report.noise_floor.insert("dead".to_owned(), f64::INFINITY);
    report.remainder.share_of_residual = f64::NAN;
    report.fit.window_s = Some(f64::NAN);
    report.remainder.location = Location {
        band_hz: Some(Interval::new(f64::NEG_INFINITY, 3.0)),
        region: [("x".to_owned(), [Some(f64::NEG_INFINITY), Some(f64::NAN)])].into_iter().collect(),
        ..Location::default()
    };
    for scores in [&mut report.fit.train.nominal, &mut report.fit.holdout.improved] {
        for score in scores.values_mut() {
            score.nrmse = f64::NAN;
            score.rmse = Some(f64::INFINITY);
            score.nrmse_windowed = Some(f64::NAN);
            score.rmse_windowed = Some(f64::NAN);
        }
    }
    let mechanism = &mut report.mechanisms[0];
    mechanism.share_explained = f64::NAN;
    mechanism.confidence = f64::INFINITY;
    mechanism.alternatives[0].confidence = f64::NAN;
    mechanism.location.windows_s["train.csv"] = vec![Interval::new(1.0, f64::INFINITY)];
    let estimate = &mut mechanism.parameters["fc"];
    (estimate.value, estimate.ci95) = (f64::NAN, Some(Interval::new(f64::NAN, 1.0)));
    let parameter = &mut report.parameters["J"];
    (parameter.nominal, parameter.value, parameter.calibrated) = (f64::NAN, f64::NAN, Some(f64::NAN));

    let json = assert_valid(&report);
    assert!(json["noise_floor"]["dead"].is_null());
    assert_eq!(json["remainder"]["location"]["band_hz"], serde_json::json!([null, 3.0]));
    assert_eq!(json["remainder"]["location"]["region"]["x"], serde_json::json!([null, null]));
    let back = Report::from_json(&report.to_json().unwrap()).unwrap();
    assert!(back.noise_floor["dead"].is_nan());
    assert!(back.mechanisms[0].parameters["fc"].value.is_nan());
    // The page prints such a report, too.
    let mut page = sample::page();
    page.report = report;
    let html = page.to_html().unwrap();
    assert!(!html.contains("NaN %") && !html.contains("inf %"));
}

#[test]
fn maps_keep_their_order() {
    let text = sample::page().report.to_json().unwrap();
    let at = |key: &str| text.find(&format!("\"{key}\": {{\n      \"nominal\"")).unwrap();
    assert!(at("J") < at("B") && at("B") < at("ks") && at("ks") < at("Jl"), "the order of the model");
}

#[test]
fn one_name_stays_a_string() {
    assert_eq!(Names::from(vec!["hub".to_owned()]), Names::One("hub".to_owned()));
    let two = Names::from(vec!["hub".to_owned(), "link".to_owned()]);
    assert_eq!(two.as_slice(), ["hub", "link"]);
    assert_eq!(serde_json::to_string(&two).unwrap(), r#"["hub","link"]"#);
}

#[test]
fn a_malformed_report_names_the_place() {
    let error = Report::from_json("{\n  \"verdict\": \"maybe\"\n}").unwrap_err().to_string();
    assert!(error.contains("maybe") && error.contains("line 2"), "{error}");
}

/// What does not carry over to the recordings held out is said, channel by channel, and what does is not.
#[test]
fn a_held_out_error_that_rises_is_told() {
    let mut report = sample::page().report;
    let reported = |report: &Report| {
        let said = sentence::summary(report);
        said.into_iter().filter(|s| s.contains("does not carry over")).collect::<Vec<_>>()
    };
    assert_eq!(reported(&report), Vec::<String>::new());
    let channels: Vec<String> = report.fit.holdout.improved.keys().cloned().collect();
    let worse = &channels[0];
    report.fit.window_s = Some(2.0);
    report.fit.holdout.calibrated[worse].nrmse = 0.32;
    report.fit.holdout.calibrated[worse].nrmse_windowed = Some(0.2545);
    report.fit.holdout.improved[worse].nrmse = 0.3667;
    report.fit.holdout.improved[worse].nrmse_windowed = Some(0.266);
    let said = reported(&report);
    assert_eq!(said.len(), 1, "{said:?}");
    assert!(
        said[0].contains("rises from 32 % to 37 % (restarted every 2.00 s it rises from 25 % to 27 %)"),
        "{said:?}"
    );
    // For the time of a window it does.
    report.fit.holdout.improved[worse].nrmse_windowed = Some(0.05);
    assert_eq!(reported(&report), Vec::<String>::new());
    let said = sentence::summary(&report);
    assert!(
        said.iter().any(|s| s.ends_with(
            "it falls from 25 % to 5.0 %): what was found carries over for that time, and not for a whole recording."
        )),
        "{said:?}"
    );
    report.fit.holdout.improved[worse].nrmse = 0.321;
    assert!(!sentence::summary(&report).iter().any(|s| s.contains("carries over")));
}

/// The noise is as large in a recording that moves half as much, and twice as large a part of it.
#[test]
fn the_noise_of_held_out_data_is_a_part_of_their_own_motion() {
    let score =
        |nrmse: f64, rmse: Option<f64>| Score { nrmse, rmse, nrmse_windowed: None, rmse_windowed: None };
    let set = |scores: [Score; 2]| FitSet {
        calibrated: [("x".to_owned(), scores[0])].into_iter().collect(),
        improved: [("x".to_owned(), scores[1])].into_iter().collect(),
        ..FitSet::default()
    };
    let floor: Ordered<f64> = [("x".to_owned(), 0.015)].into_iter().collect();
    let train = set([score(0.2, Some(0.4)), score(0.02, Some(0.04))]);
    let in_holdout = |holdout: FitSet| {
        let fit = Fit { train: train.clone(), holdout, ..Fit::default() };
        assert_eq!(fit.floor_in(&fit.train, "x", &floor), 0.015);
        fit.floor_in(&fit.holdout, "x", &floor)
    };
    let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} {b}");
    close(in_holdout(set([score(0.4, Some(0.4)), score(0.05, Some(0.05))])), 0.03);
    // A simulation that diverged says nothing of the motion, another one does.
    close(in_holdout(set([score(f64::NAN, Some(f64::INFINITY)), score(0.05, Some(0.05))])), 0.03);
    close(in_holdout(set([score(0.4, None), score(0.0, Some(0.0))])), 0.015);
    let fit = Fit { train, ..Fit::default() };
    assert!(fit.floor_in(&fit.train, "y", &floor).is_nan());
}
