//! `summary.json` against its schema, the algebra of merging, and the page.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use greybox_report::contract::{Interval, ModelId, Producer, Report, Verdict};
use greybox_report::merge::{conclude, failed, map, reduce};
use greybox_report::summary::{Level, Method, Run, Statistics, Summary, schema};

#[path = "common/browser.rs"]
mod browser;
#[path = "common/schema.rs"]
mod documents;
#[path = "common/reports.rs"]
mod reports;
#[path = "../examples/sample/mod.rs"]
mod sample;

use reports::{sampled, with_friction};

/// The sample's report with this much friction and another inertia.
fn report(fc: f64, half: f64) -> Report {
    let mut report = with_friction(fc, half);
    let inertia = &mut report.parameters["J"];
    inertia.value *= 1.0 + fc;
    inertia.ci95 = Some(Interval::new(0.99 * inertia.value, 1.01 * inertia.value));
    report
}

/// Three recordings with the mechanism, one without, one that failed.
fn parts() -> Vec<Statistics> {
    let mut consistent = report(0.0, 0.0);
    consistent.verdict = Verdict::Consistent;
    consistent.mechanisms.clear();
    consistent.fit.holdout.improved["theta"].nrmse = f64::INFINITY;
    vec![
        map("tuesday <2>.csv", Some("tuesday <2>/report.html"), &report(0.065, 0.004)),
        map("monday.csv", Some("monday/report.html"), &report(0.061, 0.004)),
        failed("broken.csv", "broken.csv: line 3: `x` is not a number", Some("correct the cell")),
        map("wednesday.csv", None, &report(0.09, 0.004)),
        map("thursday.csv", Some("thursday/report.html"), &consistent),
    ]
}

fn summary() -> Summary {
    let model = ModelId { name: "Rotary flexible link".into(), file: "link.toml".into() };
    conclude(reduce(parts()).unwrap(), Producer { version: "0.1.0".into(), ..Producer::this(3) }, model)
}

fn bytes(statistics: &Statistics) -> String {
    serde_json::to_string(statistics).unwrap()
}

#[test]
fn the_checked_in_schema_is_current() {
    documents::assert_current("summary.schema.json", &schema());
}

#[test]
fn a_summary_satisfies_the_schema_and_comes_back_unchanged() {
    let text = summary().to_json().unwrap();
    let json = documents::assert_valid(&text, &schema());
    let back: Summary = serde_json::from_str(&text).unwrap();
    assert_eq!(back.to_json().unwrap(), text);
    assert_eq!(json["verdicts"]["missing_physics"], 3);
    assert_eq!(json["mechanisms"][0]["kind"], "coulomb_friction");
    assert_eq!(json["mechanisms"][0]["family"], "friction");
    assert_eq!(json["mechanisms"][0]["equation"], "hub");
    assert_eq!(json["recordings"][0]["recording"], "monday.csv");
    assert_eq!(json["recordings"][0]["mechanisms"][0]["parameters"]["fc"]["ci95"][1], 0.065);
    assert_eq!(json["failed"][0]["recording"], "broken.csv");
    assert!(json["holdout"]["theta"]["improved"]["median"].is_number());
}

#[test]
fn joining_does_not_depend_on_order_or_grouping() {
    let all = parts();
    let whole = bytes(&reduce(all.clone()).unwrap());
    let join = |a: &Statistics, b: &Statistics| reduce([a.clone(), b.clone()]).unwrap();
    let [a, b, c, d, e] = &all[..] else { panic!("five parts") };
    let left = join(&join(&join(&join(a, b), c), d), e);
    let right = join(a, &join(b, &join(c, &join(d, e))));
    let mixed = join(&join(e, c), &join(&join(b, d), a));
    for joined in [&left, &right, &mixed] {
        assert_eq!(bytes(joined), whole);
    }
    // Every order of the five, and through JSON on the way.
    let mut order: Vec<usize> = (0..5).collect();
    for k in 0..120 {
        let mut rest: Vec<usize> = (0..5).collect();
        let mut number = k;
        for place in &mut order {
            let n = rest.len();
            *place = rest.remove(number % n);
            number /= n;
        }
        let read = |i: &usize| serde_json::from_str::<Statistics>(&bytes(&all[*i])).unwrap();
        assert_eq!(bytes(&reduce(order.iter().map(read)).unwrap()), whole, "{order:?}");
    }
}

#[test]
fn what_is_joined_twice_counts_once_and_nothing_is_neutral() {
    let all = reduce(parts()).unwrap();
    assert_eq!(bytes(&reduce([all.clone(), all.clone()]).unwrap()), bytes(&all));
    assert_eq!(bytes(&reduce([all.clone(), Statistics::default()]).unwrap()), bytes(&all));
    assert_eq!(reduce([]).unwrap(), Statistics::default());
    // Two recordings of one name and different figures are two.
    let twin = map("monday.csv", None, &report(0.07, 0.01));
    assert_eq!(reduce([all, twin]).unwrap().recordings.len(), 5);
}

#[test]
fn what_a_mechanism_does_over_the_recordings_is_known() {
    let summary = summary();
    let [friction] = &summary.mechanisms[..] else { panic!("one law: {:?}", summary.mechanisms) };
    assert_eq!(friction.found_in, ["monday.csv", "tuesday <2>.csv", "wednesday.csv"]);
    // Equal weights: the mean of all three, whatever the scatter.
    let fc = &friction.parameters["fc"];
    assert!((fc.value - (0.061 + 0.065 + 0.09) / 3.0).abs() < 1e-12);
    assert_eq!((fc.method, fc.unit.as_str(), fc.estimates.len()), (Method::RandomEffects, "N m", 3));
    let h = fc.heterogeneity.unwrap();
    assert_eq!(h.degrees_of_freedom, 2);
    assert!(h.p_value < 1e-6 && h.tau > 0.01 && h.i_squared > 0.9, "{h:?}");
    // A refitted parameter is pooled over all four recordings, a fixed one is not.
    assert_eq!(summary.parameters["J"].pooled.estimates.len(), 4);
    assert_eq!(summary.parameters["J"].nominal, sampled().parameters["J"].nominal);
    for (name, parameter) in &sampled().parameters {
        assert_eq!(summary.parameters.contains_key(name), !parameter.fixed, "{name}");
    }
    assert_eq!(summary.holdout["theta"].improved.diverged, 1);
    assert_eq!(summary.holdout["theta"].calibrated.finite, 4);
    assert!(
        summary.summary[0].contains("4 recordings diagnosed: physics is missing in 3 and"),
        "{:?}",
        summary.summary
    );
    assert!(summary.summary[0].ends_with("; 1 recording could not be diagnosed."), "{:?}", summary.summary);
    assert!(
        summary.summary[1].contains("is found in 3 of 4; fc = ")
            && summary.summary[1].contains("changes from")
    );
}

/// The same kind at another place is another mechanism; where it might as well be does not matter.
#[test]
fn a_law_is_the_same_where_kind_expression_and_place_are() {
    let mut other = report(0.06, 0.01);
    other.mechanisms[0].expression = "fc*sign(alpha')".into();
    let mut undecided = report(0.06, 0.01);
    undecided.mechanisms[0].equation = vec!["hub".to_owned(), "link".to_owned()].into();
    let all = reduce([
        map("a.csv", None, &report(0.06, 0.01)),
        map("b.csv", None, &other),
        map("c.csv", None, &undecided),
    ]);
    let summary = conclude(all.unwrap(), Producer::default(), ModelId::default());
    let found: Vec<(&str, usize)> =
        summary.mechanisms.iter().map(|m| (m.law.expression.as_str(), m.found_in.len())).collect();
    assert_eq!(found, [("fc*sign(theta')", 2), ("fc*sign(alpha')", 1)]);
}

#[test]
fn the_page_shows_every_recording_and_every_estimate() {
    let html = summary().to_html().unwrap();
    for text in [
        "Physics is missing",
        "<a href=\"monday/report.html\">monday.csv</a>",
        "<a href=\"tuesday%20%3C2%3E/report.html\">tuesday &#60;2&#62;.csv</a>",
        "<th scope=\"row\">wednesday.csv</th>",
        "broken.csv: line 3",
        "Help: correct the cell",
        "Coulomb friction <small>in the hub equation</small>",
        "3 of 4",
        "p &#60; 0.001",
        "1 diverged",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    let marks = |html: &str| html.matches("class=\"mark\"").count();
    let plotted: usize = summary().parameters.values().map(|p| p.pooled.estimates.len()).sum::<usize>() + 3;
    assert_eq!(marks(&html), plotted);
    // Every link of the contents leads somewhere, and nothing is loaded.
    for link in html.split("href=\"#").skip(1) {
        let target = link.split('"').next().unwrap();
        assert!(html.contains(&format!("id=\"{target}\"")), "{target}");
    }
    assert!(!html.contains("<script") && !html.contains("src=") && !html.contains("uPlot"));
    assert!(html.len() < 60_000, "{}", html.len());
}

#[test]
fn nothing_diagnosed_is_a_page_too() {
    let all = reduce([failed("a.csv", "<b>", None)]).unwrap();
    let summary = conclude(all, Producer::default(), ModelId::default());
    let html = summary.to_html().unwrap();
    assert!(html.contains("No recording was diagnosed") && html.contains("&#60;b&#62;"), "{html}");
    documents::assert_valid(&summary.to_json().unwrap(), &schema());
}

#[test]
fn a_browser_shows_the_page() {
    let Some(dom) = browser::dom(&summary().to_html().unwrap()) else { return };
    assert!(browser::root(&dom).contains("lang=\"en\""));
    assert_eq!(dom.matches("<svg").count(), dom.matches("</svg>").count());
    assert!(dom.contains("id=\"reading\""));
}

#[test]
fn the_page_keeps_nobody_out() {
    let Some(faults) = browser::faults(&summary().to_html().unwrap()) else { return };
    assert!(faults.is_empty(), "{faults:#?}");
}

/// Machines that were recorded `each` times: friction falls with the temperature, every tenth machine has none, and
/// machine 3 has twice as much.
fn fleet(machines: usize, each: usize) -> Summary {
    let mut parts = Vec::new();
    let wave = |k: usize, speed: f64| (speed * k as f64).sin();
    for k in 0..machines * each {
        let (machine, kelvin) = (k / each, 8.0 * wave(k, 1.7));
        let own = 0.06 * if machine == 3 { 2.0 } else { 1.0 + 0.1 * wave(machine, 2.3) };
        let mut one = report(own - 0.0005 * kelvin + 0.0003 * wave(k, 5.1), 0.0004);
        one.parameters["J"].value = 0.002 * (1.0 + 0.001 * wave(k, 3.3));
        if machine % 10 == 9 {
            one.mechanisms.clear();
        }
        let name = format!("run{k:05}.csv");
        let mut statistics = map(&name, Some(&format!("run{k:05}/report.html")), &one);
        statistics.recordings[0].run = Some(Run {
            machine: format!("M<{machine:04}>"),
            date: None,
            covariates: [("temperature [degC]".to_owned(), 20.0 + kelvin)].into_iter().collect(),
        });
        parts.push(statistics);
    }
    conclude(reduce(parts).unwrap(), Producer::default(), ModelId::default())
}

#[test]
fn machines_are_told_of_where_a_table_says_which_they_are() {
    let summary = fleet(20, 3);
    let friction = &summary.mechanisms[0];
    let share = friction.machines.as_ref().unwrap();
    assert_eq!((share.found_in.len(), share.of), (18, 20));
    assert!(share.ci95.low > 0.65 && share.ci95.high < 0.99);
    let fc = friction.parameters["fc"].machines.as_ref().unwrap();
    assert_eq!(fc.machines.len(), 18);
    let different: Vec<&str> =
        fc.machines.iter().filter(|m| m.differs.is_some()).map(|m| m.machine.as_str()).collect();
    assert_eq!(different, ["M<0003>"]);
    let slope = &fc.slopes[0];
    assert_eq!((slope.covariate.as_str(), slope.level), ("temperature [degC]", Level::Within));
    assert!(slope.significant && (slope.value + 0.0005).abs() < 5e-5, "{slope:?}");
    let told = summary.summary.join(" ");
    for text in [
        "is found in 54 of 60 recordings, in 18 of 20 machines",
        "N m from machine to machine and by",
        "N m for each degC of temperature, on one machine (p < 0.001).",
        "M<0003> (0.12",
    ] {
        assert!(told.contains(text), "{told}");
    }
    documents::assert_valid(&summary.to_json().unwrap(), &schema());
    // Two machines are no fleet; the share is told nevertheless.
    let two = fleet(2, 3);
    assert_eq!(two.mechanisms[0].parameters["fc"].machines, None);
    assert_eq!(two.mechanisms[0].machines.as_ref().unwrap().of, 2);
}

/// A machine has what is found in half of its recordings.
#[test]
fn a_machine_has_what_is_found_in_half_of_its_recordings() {
    let mut parts = Vec::new();
    let of_machines: [(&str, &[bool]); 4] = [
        ("a", &[true, false, false]),
        ("b", &[true, true, false]),
        ("c", &[false; 3]),
        ("d", &[true, false]),
    ];
    for (machine, found) in of_machines {
        for (k, found) in found.iter().enumerate() {
            let mut one = report(0.06, 0.001);
            if !found {
                one.mechanisms.clear();
            }
            let mut statistics = map(&format!("{machine}{k}"), None, &one);
            statistics.recordings[0].run =
                Some(Run { machine: machine.to_owned(), date: None, covariates: Default::default() });
            parts.push(statistics);
        }
    }
    let summary = conclude(reduce(parts).unwrap(), Producer::default(), ModelId::default());
    assert_eq!(summary.mechanisms[0].machines.as_ref().unwrap().found_in, ["b", "d"]);
}

#[test]
fn the_page_of_machines_keeps_nobody_out() {
    let html = fleet(20, 3).to_html().unwrap();
    for text in ["over the machines", "M&lt;0003", "on one machine", "18 of 20", "class=\"law\"", "Slopes"] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    let Some(faults) = browser::faults(&html) else { return };
    assert!(faults.is_empty(), "{faults:#?}");
}
/// What a browser need not lay out is not in the page: it says how much that is.
#[test]
fn a_page_of_many_recordings_stays_small() {
    let html = fleet(600, 2).to_html().unwrap();
    assert_eq!(html.matches("<th scope=\"row\"><a href=\"run").count(), 1000);
    assert!(
        html.contains("200 more recordings are not listed")
            && html.contains("480 more machines are not drawn")
    );
    assert!((300_000..600_000).contains(&html.len()), "{}", html.len());
}
