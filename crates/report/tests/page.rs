//! The structure of the page, its size, and that nothing in it can escape from its place.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use greybox_report::Page;
use greybox_report::contract::{
    Closure, ClosureRejected, Correlated, Finding, Fold, Gate, Interval, Range, RejectedLaw, Severity,
    Subset, Verdict,
};
use greybox_report::page::{Channel, Recording, Residual, Role};

#[path = "../examples/sample/mod.rs"]
mod sample;

/// The data island as JSON.
fn island(html: &str) -> serde_json::Value {
    let open = "<script type=\"application/json\" id=\"report-data\">";
    let start = html.find(open).expect("data island") + open.len();
    let end = start + html[start..].find("</script>").unwrap();
    serde_json::from_str(&html[start..end]).unwrap()
}

/// The page without uPlot, whose text is not ours.
fn own_part(html: &str) -> &str {
    &html[..html.find("<script type=\"application/json\"").unwrap()]
}

#[test]
fn the_sections_stand_in_order() {
    let html = sample::page().to_html().unwrap();
    let mut last = 0;
    for section in
        ["verdict", "fit", "signals", "residual", "mechanism", "parameters", "model", "health", "reading"]
    {
        let at = html
            .find(&format!("<section id=\"{section}\""))
            .unwrap_or_else(|| panic!("no section {section}"));
        assert!(at > last, "{section} comes too early");
        last = at;
    }
    assert_eq!(html.matches("<h1").count(), 1);
    // Every link of the contents leads somewhere.
    for link in html.split("href=\"#").skip(1) {
        let target = link.split('"').next().unwrap();
        assert!(html.contains(&format!("id=\"{target}\"")), "{target}");
    }
}

#[test]
fn the_page_says_what_a_reader_must_know() {
    let html = sample::page().to_html().unwrap();
    for text in [
        "Physics is missing",
        "Coulomb friction is missing in the hub equation; fc\u{a0}=\u{a0}0.0652\u{a0}±\u{a0}0.0018\u{a0}N m",
        "<ins>+ <var>fc</var>·sign(<var>θ</var>′)</ins>",
        "<b>94 %</b>",
        "0.0634 … 0.0670",
        "a slow sweep of v through zero velocity",
        "Little power above 6 Hz",
        "<mark>+ fc*sign(theta&#39;) </mark>",
        "kg m²",
        "held fixed",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
}

#[test]
fn what_fewer_mechanisms_would_leave_stands_in_a_table() {
    let mut page = sample::page();
    assert!(!page.to_html().unwrap().contains("With fewer mechanisms"));
    let first = page.report.mechanisms[0].clone();
    page.report
        .mechanisms
        .push(greybox_report::contract::Mechanism { kind: "dead_zone".to_owned(), ..first });
    page.report.subsets = [(vec![], 1.0), (vec![0], 0.0412), (vec![1], 0.73), (vec![0, 1], 0.001)]
        .map(|(mechanisms, left)| Subset { mechanisms, residual_share: left })
        .to_vec();
    let html = page.to_html().unwrap();
    for (name, number, left) in [
        ("None (calibrated)", 0, "100 %"),
        ("Coulomb friction", 1, "4.12 %"),
        ("Dead zone", 1, "73.0 %"),
        ("All", 2, "0.100 %"),
    ] {
        let row = format!(
            "<th scope=\"row\">{name}</th><td class=\"num\">{number}</td><td class=\"num\">{left}</td>"
        );
        assert!(html.contains(&row), "{row}");
    }
    page.report.mechanisms[1].kind = page.report.mechanisms[0].kind.clone();
    assert!(page.to_html().unwrap().contains("Coulomb friction (2)</th>"));
}

#[test]
fn what_is_proposed_stands_in_a_table_and_in_the_bar() {
    let mut page = sample::page();
    assert!(!page.to_html().unwrap().contains("Proposed, not named"));
    let mut cube = page.report.mechanisms[0].clone();
    cube.kind = "cubic_stiffness".to_owned();
    cube.expression = "fc*theta^3".to_owned();
    cube.share_explained = 0.04;
    cube.states.insert("z".to_owned(), "z' = theta - z".to_owned());
    page.report.candidates.push(cube);
    let interval = |low, high| Interval { low, high };
    let fold = Fold {
        recordings: vec!["<link>.csv".to_owned()],
        window_s: Some(interval(15.0, 20.5)),
        calibrated: f64::INFINITY,
        improved: 0.0123,
    };
    page.report.closure = Some(Closure {
        range: [("theta".to_owned(), Range { train: interval(-0.4, 0.5), outside: 0.07 })].into(),
        outside: 0.07,
        cross_validation: vec![fold],
        correlated_with: [("fc".to_owned(), Correlated { parameter: "ks".to_owned(), correlation: -0.93 })]
            .into(),
    });
    let html = page.to_html().unwrap();
    for text in [
        "<h3>Proposed, not named</h3>",
        "<var>z</var>′ = <var>θ</var> − <var>z</var>",
        "</var> −0.93</span>",
        "7 % of the held-out samples are outside",
        "&lt;link&gt;.csv, 15.0 to 20.5 s</th><td class=\"num\">diverges</td><td class=\"num\">1.23 %</td>",
        "<caption>Range of validity, SI units</caption>",
        "Cubic stiffness<small class=\"math\"><var>fc</var>·<var>θ</var><sup>3</sup>",
        "= 0.0652 ±\u{a0}0.0018 N m",
        "<span class=\"swatch share-proposed\"></span>Proposed, not named <b>4 %</b>",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    // What was tried and is not handed back.
    let law = |expression: &str| RejectedLaw {
        kind: "quadratic_stiffness".to_owned(),
        equation: "<hub>".into(),
        expression: expression.to_owned(),
    };
    page.report.closure_rejected = Some(ClosureRejected {
        gate: Gate::CrossValidation,
        laws: vec![law("kq*theta^2"), law("c*abs(theta)*theta'")],
    });
    let html = page.to_html().unwrap();
    let says = "Tried and rejected: kq·θ² in the &#60;hub&#62; equation and c·|θ|·θ′ in the &#60;hub&#62; equation. As a model of what is \
                missing, it does not predict data that it was not fitted to better than the calibrated model.";
    assert!(html.contains(says), "the page lacks {says:?}");
    // Where nobody looked for names.
    page.report.mechanisms.clear();
    (page.report.terms_only, page.report.verdict) = (true, Verdict::Unexplained);
    let html = page.to_html().unwrap();
    for text in
        ["greybox identification", "Terms are missing", "no mechanism was looked for", "holds these terms"]
    {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
}

#[test]
fn nothing_is_loaded_from_elsewhere() {
    let html = sample::page().to_html().unwrap();
    assert!(html.contains("Content-Security-Policy\" content=\"default-src 'none'"));
    for forbidden in ["src=", "@import", "url(", "<link", "<iframe", "<img", "srcset", "<base"] {
        assert!(!own_part(&html).contains(forbidden), "{forbidden}");
    }
    for attribute in ["href=\"http", "href='http", "href=\"//"] {
        assert!(!html.contains(attribute), "{attribute}");
    }
    for call in ["fetch(", "XMLHttpRequest", "WebSocket", "import("] {
        assert!(!html.contains(call), "{call}");
    }
    // uPlot and its licence travel with the page; neither closes its script element early.
    assert!(html.contains("Copyright (c) 2022 Leon Sorokin"));
    assert_eq!(html.matches("<script").count(), html.matches("</script>").count());
    assert_eq!(html.matches("<script").count(), 3);
}

/// A page in which every text from a file tries to run a script.
fn hostile() -> Page {
    const EVIL: &str =
        "</script><script>alert(1)</script><img src=x onerror=alert(2)>\" onload='alert(3)' & \u{2028}";
    let evil = || EVIL.to_owned();
    let mut page = sample::page();
    page.title = evil();
    page.report.summary = vec![evil(), evil()];
    page.report.model.name = evil();
    page.report.fit.holdout_source = evil();
    page.report.greybox.version = evil();
    for recording in &mut page.recordings {
        recording.name = evil();
        for channel in &mut recording.channels {
            (channel.name, channel.unit) = (evil(), evil());
        }
        for input in &mut recording.inputs {
            (input.name, input.unit) = (evil(), evil());
        }
    }
    for residual in &mut page.residuals {
        (residual.recording, residual.channel, residual.unit) = (evil(), evil(), evil());
        let map = residual.map.as_mut().unwrap();
        (map.x_label, map.y_label, map.value_label) = (evil(), evil(), evil());
    }
    for plot in &mut page.mechanism_plots {
        (plot.title, plot.x_label, plot.y_label) = (evil(), evil(), evil());
    }
    let report = &mut page.report;
    let mechanism = &mut report.mechanisms[0];
    (mechanism.kind, mechanism.expression, mechanism.equation) = (evil(), evil(), evil().into());
    (mechanism.replaces, mechanism.channel, mechanism.drifting) = (Some(evil()), Some(evil()), Some(evil()));
    mechanism.states.insert(evil(), evil());
    let estimate = mechanism.parameters["fc"].clone();
    mechanism.parameters.insert(evil(), estimate);
    let alternative = &mut mechanism.alternatives[0];
    (alternative.kind, alternative.expression, alternative.separate) = (evil(), Some(evil()), Some(evil()));
    let windows = mechanism.location.windows_s["train.csv"].clone();
    mechanism.location.windows_s.insert(evil(), windows);
    mechanism.location.region.insert(evil(), [None, Some(1.0)]);
    report.remainder.experiment = Some(evil());
    let parameter = report.parameters["J"].clone();
    report.parameters.insert(evil(), parameter);
    let score = report.fit.train.nominal["theta"];
    report.fit.train.nominal.insert(evil(), score);
    report.inputs.insert(evil(), report.inputs["v"].clone());
    report.findings.push(Finding {
        severity: Severity::Error,
        code: evil(),
        recording: Some(evil()),
        channel: Some(evil()),
        message: evil(),
        help: Some(evil()),
    });
    page.models.improved = format!("[equations]\n\"{}\" = \"x' = {}\"\n", "a<b", EVIL.replace('"', ""));
    page.models.nominal = evil();
    page
}

#[test]
fn text_from_a_file_stays_text() {
    let html = hostile().to_html().unwrap();
    assert_eq!(html.matches("<script").count(), 3, "only the page's own scripts");
    assert!(!own_part(&html).contains("<img"), "an image slipped in");
    assert!(!html.contains("\" onload="), "an attribute was closed");
    let data = island(&html);
    let labels: Vec<&str> = data["plots"]
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|plot| plot["series"].as_array().unwrap())
        .map(|series| series["label"].as_str().unwrap())
        .collect();
    assert!(
        labels.iter().any(|label| label.contains("alert(1)")),
        "the input's name is the label: {labels:?}"
    );
}

#[test]
fn long_recordings_keep_their_peaks_and_the_page_stays_small() {
    let n = 65_000;
    let t: Vec<f64> = (0..n).map(|i| f64::from(i) * 1e-3).collect();
    let wave =
        |k: f64| -> Vec<f64> { t.iter().map(|t| (k * t).sin() + 0.1 * (97.0 * k * t).sin()).collect() };
    let mut page = sample::page();
    page.recordings.clear();
    page.residuals.clear();
    for (index, name) in ["a.csv", "b.csv", "c.csv"].into_iter().enumerate() {
        let k = 1.0 + index as f64;
        let channel = |name: &str, k: f64| {
            let mut measured = wave(k);
            measured[31_415] = 7.25;
            Channel {
                name: name.to_owned(),
                unit: "rad".to_owned(),
                measured,
                nominal: wave(1.1 * k),
                calibrated: wave(1.2 * k),
                improved: wave(1.3 * k),
            }
        };
        let channels = vec![channel("theta", k), channel("alpha", 2.0 * k), channel("i", 3.0 * k)];
        for channel in &channels {
            page.residuals.push(Residual {
                recording: name.to_owned(),
                channel: channel.name.clone(),
                unit: channel.unit.clone(),
                t: t.clone(),
                before: wave(1.4 * k),
                after: wave(1.5 * k),
                noise_sigma: 0.01,
                windows: Vec::new(),
                spectrum: None,
                map: None,
                correlations: Vec::new(),
            });
        }
        page.recordings.push(Recording {
            name: name.to_owned(),
            role: Role::Train,
            t: t.clone(),
            holdout_from: Some(52.0),
            channels,
            inputs: Vec::new(),
        });
    }
    let html = page.to_html().unwrap();
    assert!(html.len() < 3_000_000, "{} bytes", html.len());
    let data = island(&html);
    assert_eq!(data["axes"].as_array().unwrap().len(), 1, "equal time axes are stored once");
    for plot in data["plots"].as_array().unwrap() {
        for series in plot["series"].as_array().unwrap() {
            let values = series["data"].as_array().unwrap();
            assert!(values.len() <= 2500);
            if series["label"] == "measured" {
                assert!(values.iter().any(|v| v == 7.25), "the spike of one sample is kept");
            }
        }
    }
}

#[test]
fn an_empty_page_is_a_page() {
    let mut page = sample::page();
    page.recordings.clear();
    page.residuals.clear();
    page.mechanism_plots.clear();
    page.models = Default::default();
    page.report.mechanisms.clear();
    page.report.parameters.clear();
    page.report.fit = Default::default();
    page.report.findings.clear();
    page.report.inputs.clear();
    for (verdict, significant, remainder, says) in [
        (Verdict::Consistent, false, 0.0, "nothing beyond measurement noise is missing"),
        (
            Verdict::Consistent,
            true,
            0.1,
            "what is left passes for measurement noise, but for a small part of it",
        ),
        (Verdict::Unexplained, true, 0.3, "no mechanism in the library explains it"),
        (Verdict::Unexplained, true, 0.001, "greybox check --model"),
    ] {
        page.report.verdict = verdict;
        page.report.remainder.significant = significant;
        page.report.remainder.share_of_residual = remainder;
        page.report.summary.clear();
        let html = page.to_html().unwrap();
        assert!(html.contains(says), "{verdict:?}");
        assert!(html.contains("Nothing to remark"));
        assert_eq!(island(&html)["plots"].as_array().unwrap().len(), 0);
    }
}

#[test]
fn without_an_improved_model_its_column_is_left_out() {
    let mut page = sample::page();
    page.report.verdict = Verdict::Consistent;
    page.report.mechanisms.clear();
    page.report.fit.train.improved.clear();
    page.report.fit.holdout.improved.clear();
    page.models.improved.clear();
    let html = page.to_html().unwrap();
    assert!(!html.contains(">Improved"));
    assert!(html.contains("The equations stay as they are."));
    let header = html.split("<table class=\"fit\">").nth(1).unwrap().split("</thead>").next().unwrap();
    assert_eq!(header.matches("<th ").count(), 4);
}

#[test]
fn equal_pages_give_equal_bytes() {
    assert_eq!(sample::page().to_html().unwrap(), sample::page().to_html().unwrap());
}

#[test]
fn what_drifts_and_the_experiment_are_shown() {
    let mut page = sample::page();
    let html = page.to_html().unwrap();
    assert!(html.contains("<b>To separate them:</b> drive v slowly, up to 3.5 V as now"), "the experiment");
    let mechanism = &mut page.report.mechanisms[0];
    mechanism.drifting = Some("ks".to_owned());
    mechanism.experiment = None;
    let html = page.to_html().unwrap();
    let place = format!("of {} in the hub equation", greybox_report::expression::text("ks"));
    assert!(html.contains(&place), "the parameter that drifts");
    assert!(!html.contains("To separate them"));
}
