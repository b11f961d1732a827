//! Two diagnoses side by side: what counts as a change, the schema, and the page.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use greybox_report::Comparison;
use greybox_report::compare::schema;
use greybox_report::contract::{Estimate, Finding, Interval, Parameter, Report, Severity, Verdict};

#[path = "common/browser.rs"]
mod browser;
#[path = "common/schema.rs"]
mod documents;
#[path = "common/reports.rs"]
mod reports;
#[path = "../examples/sample/mod.rs"]
mod sample;

use reports::{sampled, with_friction};

fn compared(before: &Report, after: &Report) -> Comparison {
    Comparison::of(("march", before), ("april <2>", after))
}

#[test]
fn the_checked_in_schema_is_current() {
    documents::assert_current("comparison.schema.json", &schema());
}

#[test]
fn a_comparison_satisfies_the_schema_and_comes_back_unchanged() {
    let mut after = with_friction(0.09, 0.004);
    after.fit.holdout.improved["theta"].nrmse = f64::INFINITY;
    let text = compared(&with_friction(0.06, 0.004), &after).to_json().unwrap();
    let json = documents::assert_valid(&text, &schema());
    let back: Comparison = serde_json::from_str(&text).unwrap();
    assert_eq!(back.to_json().unwrap(), text);
    assert_eq!(json["mechanisms"][0]["kind"], "coulomb_friction");
    assert_eq!(json["mechanisms"][0]["parameters"]["fc"]["changed"], true);
    assert_eq!(json["mechanisms"][0]["parameters"]["fc"]["before"]["value"], 0.06);
    assert!(json["holdout"]["theta"]["after"]["improved"].is_null());
}

#[test]
fn a_report_beside_itself_has_not_changed() {
    let c = compared(sampled(), sampled());
    assert!(c.cautions.is_empty(), "{:?}", c.cautions);
    assert!(c.findings_new.is_empty() && c.findings_gone.is_empty());
    let changes = c.mechanisms.iter().flat_map(|m| m.parameters.values()).chain(c.parameters.values());
    assert!(changes.clone().count() > 3 && changes.clone().all(|c| c.changed != Some(true)));
    assert!(c.mechanisms.iter().all(|m| m.before == m.after && m.before.is_some()));
    assert!(c.to_html().unwrap().contains("<span class=\"badge\">Unchanged</span>"));
}

/// √(3² + 4²) = 5: a difference of 4.9 half-widths is none, one of 5.1 is.
#[test]
fn a_change_is_more_than_the_half_width_of_the_difference() {
    for (after, changed) in [(0.149, false), (0.151, true), (0.049, true), (0.051, false)] {
        let c = compared(&with_friction(0.1, 0.03), &with_friction(after, 0.04));
        assert_eq!(c.mechanisms[0].parameters["fc"].changed, Some(changed), "{after}");
        assert_eq!(c.summary[1].contains("but changed: f"), changed, "{:?}", c.summary);
    }
    // Without an interval, or in another unit, nothing can be said.
    let mut other = with_friction(0.2, 0.01);
    other.mechanisms[0].parameters["fc"].unit = "mN m".into();
    assert_eq!(compared(&with_friction(0.1, 0.01), &other).mechanisms[0].parameters["fc"].changed, None);
    other.mechanisms[0].parameters["fc"].ci95 = None;
    assert_eq!(compared(&with_friction(0.1, 0.01), &other).mechanisms[0].parameters["fc"].changed, None);
}

#[test]
fn what_is_new_what_is_gone_and_what_moved_are_told_apart() {
    let old = with_friction(0.06, 0.004);
    let mut new = with_friction(0.06, 0.004);
    new.mechanisms[0].kind = "viscous_friction".into();
    let c = compared(&old, &new);
    assert_eq!(c.mechanisms.len(), old.mechanisms.len() + 1);
    assert_eq!(c.summary.iter().filter(|s| s.ends_with(" is new.")).count(), 1, "{:?}", c.summary);
    assert_eq!(c.summary.iter().filter(|s| s.ends_with(" is gone.")).count(), 1, "{:?}", c.summary);

    // So is a law of the same kind and place with other parameters; the two are told apart.
    let mut other = with_friction(0.06, 0.004);
    other.mechanisms[0].expression = "fd*sign(theta')".into();
    let fc = other.mechanisms[0].parameters.shift_remove("fc").unwrap();
    other.mechanisms[0].parameters.insert("fd".into(), fc);
    let c = compared(&old, &other);
    assert_eq!(c.mechanisms.len(), old.mechanisms.len() + 1);
    assert!(
        c.summary.contains(&"Coulomb friction in the hub equation, fd·sign(θ′), is new.".to_owned()),
        "{:?}",
        c.summary
    );
    assert!(c.summary.iter().any(|s| s.ends_with("fc·sign(θ′), is gone.")), "{:?}", c.summary);

    // The same kind in another equation is another mechanism.
    let mut moved = with_friction(0.06, 0.004);
    moved.mechanisms[0].location.equation = Some("link".into());
    assert_eq!(compared(&old, &moved).mechanisms.len(), old.mechanisms.len() + 1);

    let mut agreed = old.clone();
    agreed.mechanisms.clear();
    agreed.verdict = Verdict::Consistent;
    let c = compared(&old, &agreed);
    assert_eq!(c.summary[0], "Before: physics is missing. After: the model agrees with the recordings.");
}

#[test]
fn what_makes_figures_incomparable_is_said() {
    let mut after = sampled().clone();
    after.model.file = "other.toml".into();
    after.samples.train += 1;
    after.greybox.version = "9.9.9".into();
    after.parameters[0].nominal += 1.0;
    let c = compared(sampled(), &after);
    for part in ["other.toml", "different recordings", "9.9.9", "different values"] {
        assert!(c.cautions.iter().any(|s| s.contains(part)), "{part}: {:?}", c.cautions);
    }
}

/// More friction, and a finding that was not there.
fn changed() -> Comparison {
    let mut after = with_friction(0.09, 0.004);
    after.findings.push(Finding {
        severity: Severity::Warning,
        code: "clipping".into(),
        recording: Some("<script>.csv".into()),
        channel: None,
        message: "it clips".into(),
        help: None,
    });
    compared(&with_friction(0.06, 0.004), &after)
}

#[test]
fn the_page_shows_both_runs_and_escapes_what_comes_from_files() {
    let html = changed().to_html().unwrap();
    for text in [
        "<span class=\"badge\">Changed</span>",
        "<dd>march</dd>",
        "<dd>april &#60;2&#62;</dd>",
        "Coulomb friction <small>in the hub equation: <b>in both, changed</b></small>",
        "0.060 ±\u{a0}0.004",
        "0.090 ±\u{a0}0.004",
        "+0.030 ±\u{a0}0.006, changed",
        "<svg class=\"change\"",
        "&#60;script&#62;.csv: it clips",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    for link in html.split("href=\"#").skip(1) {
        let target = link.split('"').next().unwrap();
        assert!(html.contains(&format!("id=\"{target}\"")), "{target}");
    }
    assert!(!html.contains("<script") && !html.contains("src="));
}

#[test]
fn the_page_keeps_nobody_out() {
    let Some(faults) = browser::faults(&changed().to_html().unwrap()) else { return };
    assert!(faults.is_empty(), "{faults:#?}");
}

#[test]
fn hostile_names_do_nothing_in_the_browser() {
    let evil = "</title></style><script>document.documentElement.dataset.owned='1'</script>\
                <img src=x onerror=\"document.documentElement.dataset.owned='2'\">";
    let hostile = |fc: f64| {
        let mut report = with_friction(fc, 0.004);
        report.model.name = evil.into();
        report.model.file = evil.into();
        report.greybox.version = format!("{fc} {evil}");
        report.fit.holdout_source = format!("{fc} {evil}");
        report.mechanisms[0].kind = evil.into();
        report.mechanisms[0].expression = evil.into();
        report.mechanisms[0].location.equation = Some(evil.into());
        report.mechanisms[0].parameters.insert(
            evil.into(),
            Estimate { value: fc, ci95: Some(Interval::new(fc - 0.01, fc + 0.01)), unit: evil.into() },
        );
        let first = report.parameters[0].clone();
        report
            .parameters
            .insert(evil.into(), Parameter { unit: Some(evil.into()), value: fc, fixed: false, ..first });
        for set in [
            &mut report.fit.holdout.nominal,
            &mut report.fit.holdout.calibrated,
            &mut report.fit.holdout.improved,
        ] {
            let score = set["theta"];
            set.insert(evil.into(), score);
        }
        report.findings.push(Finding {
            severity: Severity::Warning,
            code: evil.into(),
            recording: Some(evil.into()),
            channel: Some(evil.into()),
            message: format!("{fc} {evil}"),
            help: Some(evil.into()),
        });
        report
    };
    let html = Comparison::of((evil, &hostile(0.06)), (evil, &hostile(0.09))).to_html().unwrap();
    assert!(!html.contains("<script") && !html.contains("<img"), "something of a file became an element");
    assert!(html.matches("&lt;img").count() + html.matches("&#60;img").count() > 10);
    let Some(dom) = browser::dom(&html) else { return };
    assert!(!browser::root(&dom).contains("data-owned"), "{}", browser::root(&dom));
    let attributes = ["src=\"", "href=\""].map(|name| format!(" {name}"));
    for value in attributes.iter().flat_map(|name| dom.split(name.as_str()).skip(1)) {
        assert!(value.starts_with('#'), "{} leaves the page", &value[..20]);
    }
}
