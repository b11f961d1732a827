//! The page of a controller: its structure, its words, that nothing escapes from its place, and a browser.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use greybox_control::{Margins, Metrics, Tracking, TrackingError, Verdict};
use greybox_report::ControlPage;
use greybox_report::contract::{ModelId, Producer};
use greybox_report::control::{
    Figure, IntegralAction, LawKind, LawState, LoopRun, ObserverPage, Perturbed, PerturbedMargins, Quantity,
    SetPoint,
};

#[path = "common/browser.rs"]
mod browser;

fn quantity(name: &str, unit: &str) -> Quantity {
    Quantity { name: name.into(), unit: unit.into() }
}

fn margins(gain: f64, phase: f64) -> Margins {
    Margins { gain, lower_gain: 0.25, phase, delay: 0.0125, sensitivity: 1.5 }
}

/// A step of a second-order loop, and one back.
fn page() -> ControlPage {
    let t: Vec<f64> = (0..400).map(|k| f64::from(k) * 0.01).collect();
    let wanted = |t: f64| if t < 2.0 { 0.5 } else { -0.5 };
    let theta: Vec<f64> = t.iter().map(|t| wanted(*t) * (1.0 - (-8.0 * (t % 2.0)).exp())).collect();
    let step = |set_point: f64| Metrics {
        set_point,
        step: 2.0 * set_point,
        settling: Some(0.489),
        overshoot: 0.0123,
        final_error: 0.00213,
        peak_to_peak: 0.0004,
        rms_error: 0.0871,
        largest_command: 10.0,
        saturated: 0.04,
        effort: 3.21,
    };
    let point = |value: f64| SetPoint {
        value,
        state: vec![value, 0.0],
        command: 0.6 * value,
        poles: vec![[-6.0, 8.0], [-6.0, -8.0]],
        held_poles: vec![[0.99, 0.008], [0.99, -0.008]],
        stuck_poles: Vec::new(),
        margins: None,
    };
    let widened = |by: f64| theta.iter().map(|v| v + by).collect::<Vec<f64>>();
    ControlPage {
        title: "Controller of Arm".into(),
        producer: Producer { version: "0.1.0".into(), ..Producer::this(7) },
        model: ModelId { name: "Arm".into(), file: "arm.toml".into() },
        verdict: Verdict::Settles,
        method: LawKind::Lqr,
        settings: vec![("Typical size of the command", "5 V".into())],
        input: quantity("v", "V"),
        limits: [-10.0, 10.0],
        dt: 1e-3,
        states: vec![
            LawState { quantity: quantity("theta", "rad"), size: 0.5, gain: 10.3 },
            LawState { quantity: quantity("theta'", "rad/s"), size: 5.0, gain: 1.25 },
        ],
        tracked: 0,
        reference: "r".into(),
        law: "saturate(0.6*r - 10.3*(theta - r) - 1.25*theta', 10)".into(),
        observer: None,
        delay: 0.0,
        left_out: vec![("arm".into(), "ad*sin(om*t)".into())],
        set_points: vec![point(-0.5), point(0.5)],
        steps: vec![step(0.5), step(-0.5)],
        is_trajectory: false,
        reads_derivatives: false,
        tracking: None,
        family: Some(Perturbed {
            members: 50,
            diverged: 0,
            settled: 50,
            deviations: vec![(quantity("J", "kg m^2"), 0.02, 0.002)],
            figures: vec![Figure {
                name: "Settling",
                unit: "s".into(),
                own: 0.489,
                median: 0.5,
                worst: f64::INFINITY,
            }],
            margins: Some(PerturbedMargins {
                own: margins(2.5, 0.8),
                median: margins(2.25, 0.7),
                worst: Margins { delay: f64::INFINITY, ..margins(1.75, 0.5) },
                unstable: 0,
            }),
            tracked: [widened(-0.05), widened(0.05)],
            command: [vec![-10.0; t.len()], vec![10.0; t.len()]],
        }),
        run: LoopRun {
            reference: t.iter().map(|t| wanted(*t)).collect(),
            command: t.iter().map(|t| 10.0 * wanted(*t) * (-8.0 * (t % 2.0)).exp()).collect(),
            states: vec![
                (quantity("theta", "rad"), theta),
                (quantity("theta'", "rad/s"), vec![0.0; t.len()]),
            ],
            tracked: 0,
            diverged: None,
            t,
        },
        files: vec![("law.c", "the law as C99")],
    }
}

/// The page without uPlot, whose text is not ours.
fn own_part(html: &str) -> &str {
    &html[..html.find("<script type=\"application/json\"").unwrap()]
}

#[test]
fn the_page_says_what_an_engineer_signs() {
    let html = page().to_html().unwrap();
    let mut last = 0;
    for section in ["verdict", "loop", "family", "law", "stability", "promises", "reading"] {
        let at = html.find(&format!("<section id=\"{section}\"")).unwrap_or_else(|| panic!("no {section}"));
        assert!(at > last, "{section} comes too early");
        last = at;
    }
    assert_eq!(html.matches("<h1").count(), 1);
    for link in html.split("href=\"#").skip(1) {
        let target = link.split('"').next().unwrap();
        assert!(html.contains(&format!("id=\"{target}\"")), "{target}");
    }
    for text in [
        "θ stays within 2\u{a0}% of every step after at most 0.489 s, overshoots by 1.2\u{a0}% at most and ends within \
         0.00213 rad",
        "Of 50 plants with parameters drawn around the model's, 50 settle at every set point; none diverges."
            .replace('\'', "&#39;")
            .as_str(),
        // 0.5 rad.
        "On all of them the gain margin is at least 1.75, the phase margin at least 28.6° and the delay margin unlimited.",
        "<th scope=\"row\">Worst plant</th><td class=\"num\">1.75</td><td class=\"num\">0.250</td><td class=\"num\">28.6</td><td class=\"num\">any</td>",
        "v reaches 10.0 V, its limit, and is there for 4.0\u{a0}% of a step at most.",
        "<th scope=\"row\" class=\"math\"><var>θ</var>′</th><td class=\"num strong\">1.25</td><td class=\"unit\">V/(rad/s)</td>",
        "−6.00 ± 8.00\u{202f}i",
        // A natural frequency of 10/s and a damping ratio of 0.6.
        "<td class=\"num\">1.59</td><td class=\"num\">0.60</td><td class=\"num\">0.167</td></tr>",
        "<td class=\"num\">0.300</td><td class=\"num\">0.9900</td>",
        "<td class=\"num strong\">not reached</td>",
        "saturate(0.6*r - 10.3*(theta - r) - 1.25*theta&#39;, 10)",
        "<code>law.c</code>",
        "There is no integral action",
    ] {
        let plain = |s: &str| s.replace('\u{a0}', " ");
        assert!(plain(&html).contains(&plain(text)), "the page lacks {text:?}");
    }
    // Every drawing and every table is named for who cannot see it.
    assert_eq!(
        html.matches("<svg class=\"drawing\"").count(),
        html.matches("role=\"img\" aria-label=\"Poles").count()
    );
    assert_eq!(own_part(&html).matches("<table").count(), own_part(&html).matches("<caption").count());
}

#[test]
fn every_verdict_has_its_words() {
    let mut page = page();
    for (verdict, says) in [
        (Verdict::Settles, "The loop settles<"),
        (Verdict::Fragile, "not on every perturbed plant"),
        (Verdict::Unsettled, "does not settle at every set point"),
        (Verdict::Diverges, "The loop runs away"),
    ] {
        page.verdict = verdict;
        assert!(page.to_html().unwrap().contains(says), "{verdict:?}");
    }
    page.run.diverged = Some(0.25);
    page.family = None;
    page.limits = [f64::NEG_INFINITY, f64::INFINITY];
    page.steps.clear();
    page.set_points.clear();
    let html = page.to_html().unwrap().replace('\u{a0}', " ");
    assert!(html.contains("θ leaves every bound after 0.25 s."));
    assert!(html.contains("No perturbed plants were tried") && html.contains("not limited"));
    let main = own_part(&html).split("<main ").nth(1).unwrap();
    assert!(!main.contains("<section id=\"family\"") && !main.contains("NaN") && !main.contains(">inf"));
}

/// Every text that a model file can bring tries to run a script.
#[test]
fn text_from_a_file_stays_text() {
    const EVIL: &str =
        "</script><script>alert(1)</script><img src=x onerror=alert(2)>\" onload='alert(3)' & \u{2028}";
    let evil = || EVIL.to_owned();
    let mut page = page();
    page.title = evil();
    page.producer.version = evil();
    (page.model.name, page.model.file) = (evil(), evil());
    page.input = quantity(EVIL, EVIL);
    page.states[1].quantity = quantity(EVIL, EVIL);
    page.states[0].quantity = quantity(EVIL, EVIL);
    page.run.states[0].0 = quantity(EVIL, EVIL);
    page.run.states[1].0 = quantity(EVIL, EVIL);
    page.reference = evil();
    page.law = evil();
    page.left_out = vec![(evil(), evil())];
    page.settings = vec![("Size", evil())];
    let family = page.family.as_mut().unwrap();
    family.deviations[0].0 = quantity(EVIL, EVIL);
    family.figures[0].unit = evil();
    let html = page.to_html().unwrap();
    assert_eq!(html.matches("<script").count(), 3, "only the page's own scripts");
    assert!(!own_part(&html).contains("<img"), "an image slipped in");
    assert!(!html.contains("\" onload="), "an attribute was closed");
    let Some(dom) = browser::dom(&html) else { return };
    assert!(browser::root(&dom).contains("data-errors=\"0\""), "{}", browser::root(&dom));
}

#[test]
fn a_browser_draws_all_plots() {
    let Some(dom) = browser::dom(&page().to_html().unwrap()) else { return };
    // Tracked state, command, one more state.
    assert!(browser::root(&dom).contains("data-plots=\"3\""), "{}", browser::root(&dom));
    assert!(browser::root(&dom).contains("data-errors=\"0\""), "{}", browser::root(&dom));
    assert_eq!(dom.matches("<canvas").count(), 3);
}

#[test]
fn poles_that_cannot_be_drawn_are_left_out() {
    use greybox_report::svg::{Plane, pole_plot};
    assert!(pole_plot(&[&[[f64::NAN, 0.0]]], Plane::Continuous, "p").is_none());
    assert!(pole_plot(&[], Plane::Sampled, "p").is_none());
    // Real poles only, poles far apart, one pole at the edge.
    for poles in [&[[-1.0, 0.0]][..], &[[-1e12, 0.0], [-1e-9, 3.0]], &[[0.0, 0.0]], &[[1e308, 1e308]]] {
        for plane in [Plane::Continuous, Plane::Sampled] {
            if let Some(svg) = pole_plot(&[poles], plane, "a < b") {
                assert!(
                    !svg.contains("NaN") && !svg.contains("inf") && svg.contains("a &lt; b"),
                    "{poles:?}"
                );
            }
        }
    }
    // The unit circle goes through 1 and is drawn where it lies in the frame.
    let svg = pole_plot(&[&[[0.999, 0.001], [0.999, -0.001]]], Plane::Sampled, "z").unwrap();
    let edge = svg.split("class=\"edge\" d=\"").nth(1).unwrap().split('"').next().unwrap();
    assert!(edge.starts_with('M') && edge.contains('L'), "{edge}");
}

#[test]
fn the_page_keeps_nobody_out() {
    let Some(faults) = browser::faults(&page().to_html().unwrap()) else { return };
    assert!(faults.is_empty(), "{faults:#?}");
}

/// A plant on which the loop is unstable has no margin, and the page says so instead of a number.
#[test]
fn an_unstable_plant_is_told() {
    let mut page = page();
    let family = page.family.as_mut().unwrap();
    let margins = family.margins.as_mut().unwrap();
    (margins.worst, margins.unstable) = (Margins::NONE, 3);
    let html = page.to_html().unwrap();
    for text in [
        "On 3 of them the linearised loop is unstable at a set point.",
        "3 plants are unstable at a set point",
        "<td class=\"num\">unbounded</td>",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    assert!(!html.contains("On all of them"));
    page.family.as_mut().unwrap().margins = None;
    assert!(!page.to_html().unwrap().contains("Median plant</th><td"));
}

/// A loop that cannot stay at rest is said to hunt, unless its law holds the command there.
#[test]
fn a_loop_that_hunts_is_told() {
    let mut page = page();
    let hunts =
        "While friction holds θ, the loop has a pole at +27.5 1/s: it cannot stay at rest, and hunts.";
    assert!(!page.to_html().unwrap().contains("While friction holds"));
    page.set_points[1].stuck_poles = vec![[27.5, 0.0], [-30.0, 0.0]];
    assert!(page.to_html().unwrap().contains(hunts));
    let at_rest = IntegralAction::AtRest { time: 0.003, step: 0.0015, integral_time: 0.2 };
    let said = [
        (IntegralAction::Off, "There is no integral action", true),
        (IntegralAction::Disturbance, "The disturbance takes out what acts like a constant command", true),
        (at_rest, "In motion there is no integral action", false),
    ];
    for (integral, promise, is_said) in said {
        let (kind, disturbance) = ("steady-state Kalman filter", "d".to_owned());
        page.observer = Some(ObserverPage { kind, disturbance, integral, sensors: Vec::new() });
        let html = page.to_html().unwrap();
        assert!(html.contains(promise), "{integral:?}");
        assert_eq!(html.contains(hunts), is_said, "{integral:?}");
        let others = said.iter().filter(|other| other.1 != promise);
        others.for_each(|other| assert!(!html.contains(other.1), "{integral:?}: {}", other.1));
    }
}

/// Along a trajectory the page has errors in the place of steps, and says what the law is given.
#[test]
fn a_trajectory_has_its_errors() {
    let mut page = page();
    page.steps.clear();
    (page.is_trajectory, page.reads_derivatives, page.verdict) = (true, true, Verdict::Strays);
    page.tracking = Some(Tracking {
        span: 1.0,
        error: TrackingError { rms: 0.021, largest: 0.132 },
        later_error: TrackingError { rms: 0.0123, largest: 0.0456 },
        largest_command: 7.5,
        saturated: 0.03,
        effort: 4.5,
    });
    let html = page.to_html().unwrap().replace('\u{a0}', " ");
    for text in [
        "The loop does not stay with its trajectory",
        "After the first quarter of the time θ is 0.0456 rad from its trajectory at most, 4.6 % of its span, and 0.0123 rad in \
         the root mean square; over the whole of the time 0.132 rad at most.",
        "50 stay with the trajectory; none diverges.",
        "v reaches 7.50 V, its limit, and is there for 3.0 % of the time.",
        "<sub>d</sub>",
        "the law must be given the rate and the acceleration",
    ] {
        assert!(html.contains(text), "the page lacks {text:?}");
    }
    assert!(!html.contains("What each step of") && !html.contains("Settling to 2"));
    (page.tracking, page.verdict) = (None, Verdict::Diverges);
    page.run.diverged = Some(0.3);
    let html = page.to_html().unwrap().replace('\u{a0}', " ");
    assert!(html.contains("<dd>not reached<small>") && html.contains("leaves every bound after 0.3 s"));
}
