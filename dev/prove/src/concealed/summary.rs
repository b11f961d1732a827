//! The suite's figures: by kind, by masking, by tier, and against the goals.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::Finished;
use super::baseline::Verdict;
use super::case::TruthEffect;
use super::score::is_worse;
use greybox_plants::kind::Kind;

/// The suite's figures; `None` where no case tells.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct Figures {
    pub(crate) detected: Option<f64>,
    pub(crate) false_alarms: Option<f64>,
    pub(crate) exact: Option<f64>,
    pub(crate) family: Option<f64>,
    pub(crate) equation: Option<f64>,
    pub(crate) spurious: Option<f64>,
    pub(crate) held_out: Option<f64>,
    pub(crate) worse_than_calibrated: Option<f64>,
    pub(crate) parameter_error: Option<f64>,
    pub(crate) coverage: Option<f64>,
    pub(crate) location: Option<f64>,
    pub(crate) outside: Option<f64>,
    pub(crate) confidently_wrong: Option<f64>,
    pub(crate) outside_held_out: Option<f64>,
    pub(crate) outside_term: Option<f64>,
    pub(crate) seconds_median: Option<f64>,
    pub(crate) seconds_worst: Option<f64>,
    pub(crate) failures: Option<f64>,
}

/// What a figure must reach.
struct Goal {
    name: &'static str,
    what: &'static str,
    get: fn(&Figures) -> Option<f64>,
    low: f64,
    high: f64,
    /// How it is printed.
    shown: fn(f64) -> String,
}

fn percent(x: f64) -> String {
    format!("{:.1} %", 100.0 * x)
}

fn plain(x: f64) -> String {
    format!("{x:.3}")
}

fn seconds(x: f64) -> String {
    format!("{x:.1} s")
}

const NONE: f64 = f64::NEG_INFINITY;
const MUCH: f64 = f64::INFINITY;

/// Held-out error over the oracle's within which a case counts as good, and one whose law no name tells.
const HELD_OUT: f64 = 1.15;
const OUTSIDE_HELD_OUT: f64 = 1.5;

/// (A run that failed has no held-out error, and is not within any bound.)
fn is_near(f: &Finished) -> bool {
    let bound = if f.truth.class == "outside" { OUTSIDE_HELD_OUT } else { HELD_OUT };
    f.score.holdout.is_some_and(|r| r <= bound)
}

const GOALS: [Goal; 18] = [
    Goal {
        name: "detected",
        what: "effects detected",
        get: |f| f.detected,
        low: 0.98,
        high: MUCH,
        shown: percent,
    },
    Goal {
        name: "false_alarms",
        what: "false alarms on nulls",
        get: |f| f.false_alarms,
        low: NONE,
        high: 0.02,
        shown: percent,
    },
    Goal { name: "exact", what: "kind right", get: |f| f.exact, low: 0.90, high: MUCH, shown: percent },
    Goal { name: "family", what: "family right", get: |f| f.family, low: 0.96, high: MUCH, shown: percent },
    Goal {
        name: "equation",
        what: "equation right",
        get: |f| f.equation,
        low: 0.97,
        high: MUCH,
        shown: percent,
    },
    Goal {
        name: "spurious",
        what: "spurious mechanisms per case",
        get: |f| f.spurious,
        low: NONE,
        high: 0.1,
        shown: plain,
    },
    Goal {
        name: "held_out",
        what: "held-out error within 1.15 x oracle",
        get: |f| f.held_out,
        low: 0.90,
        high: MUCH,
        shown: percent,
    },
    Goal {
        name: "worse_than_calibrated",
        what: "held-out worse than calibrated",
        get: |f| f.worse_than_calibrated,
        low: NONE,
        high: 0.0,
        shown: percent,
    },
    Goal {
        name: "parameter_error",
        what: "median parameter error",
        get: |f| f.parameter_error,
        low: NONE,
        high: 0.05,
        shown: percent,
    },
    Goal {
        name: "coverage",
        what: "95 % intervals that hold the truth",
        get: |f| f.coverage,
        low: 0.90,
        high: 0.98,
        shown: percent,
    },
    Goal {
        name: "location",
        what: "median overlap of windows",
        get: |f| f.location,
        low: 0.6,
        high: MUCH,
        shown: plain,
    },
    Goal {
        name: "outside",
        what: "outside: unexplained or a relative",
        get: |f| f.outside,
        low: 0.90,
        high: MUCH,
        shown: percent,
    },
    Goal {
        name: "confidently_wrong",
        what: "outside: confidently wrong",
        get: |f| f.confidently_wrong,
        low: NONE,
        high: 0.0,
        shown: percent,
    },
    Goal {
        name: "outside_held_out",
        what: "outside: within 1.5 x oracle",
        get: |f| f.outside_held_out,
        low: 0.7,
        high: MUCH,
        shown: percent,
    },
    Goal {
        name: "outside_term",
        what: "outside: the law itself, where a term is it",
        get: |f| f.outside_term,
        low: 0.8,
        high: MUCH,
        shown: percent,
    },
    Goal {
        name: "seconds_median",
        what: "time, median",
        get: |f| f.seconds_median,
        low: NONE,
        high: 15.0,
        shown: seconds,
    },
    Goal {
        name: "seconds_worst",
        what: "time, worst",
        get: |f| f.seconds_worst,
        low: NONE,
        high: 120.0,
        shown: seconds,
    },
    Goal {
        name: "failures",
        what: "runs that failed",
        get: |f| f.failures,
        low: NONE,
        high: 0.0,
        shown: percent,
    },
];

impl Goal {
    fn wanted(&self) -> String {
        match (self.low > NONE, self.high < MUCH) {
            (true, true) => format!("{} to {}", (self.shown)(self.low), (self.shown)(self.high)),
            (true, false) => format!(">= {}", (self.shown)(self.low)),
            _ => format!("<= {}", (self.shown)(self.high)),
        }
    }

    fn is_time(&self) -> bool {
        self.name.starts_with("seconds")
    }
}

fn share(flags: impl Iterator<Item = bool>) -> Option<f64> {
    let (yes, all) = flags.fold((0usize, 0usize), |(y, n), f| (y + usize::from(f), n + 1));
    (all > 0).then(|| yes as f64 / all as f64)
}

fn median(mut x: Vec<f64>) -> Option<f64> {
    x.sort_by(f64::total_cmp);
    let n = x.len();
    (n > 0).then(|| 0.5 * (x[(n - 1) / 2] + x[n / 2]))
}

impl Figures {
    /// Of all finished cases.
    pub(crate) fn of(finished: &[Finished]) -> Figures {
        let of = |class: &'static str| finished.iter().filter(move |f| f.truth.class == class);
        let effects = || of("effect").map(|f| &f.score);
        let all = || finished.iter().map(|f| &f.score);
        let spurious: Vec<f64> = effects().filter_map(|s| s.spurious).map(|n| n as f64).collect();
        Figures {
            detected: share(effects().map(|s| s.detected)),
            false_alarms: share(of("null").map(|f| f.score.false_alarm)),
            exact: share(effects().filter_map(|s| s.exact)),
            family: share(effects().filter_map(|s| s.family)),
            equation: share(effects().filter_map(|s| s.equation)),
            spurious: (!spurious.is_empty()).then(|| spurious.iter().sum::<f64>() / spurious.len() as f64),
            held_out: share(of("effect").chain(of("null")).map(is_near)),
            worse_than_calibrated: share(all().map(is_worse)),
            parameter_error: median(all().flat_map(|s| s.parameter_errors.iter().map(|e| e.1)).collect()),
            coverage: share(all().flat_map(|s| s.coverage.iter().map(|c| c.1))),
            location: median(all().filter_map(|s| s.iou).collect()),
            outside: share(all().filter_map(|s| s.outside)),
            confidently_wrong: share(all().filter_map(|s| s.confidently_wrong)),
            outside_held_out: share(of("outside").map(is_near)),
            outside_term: share(all().filter_map(|s| s.term)),
            seconds_median: median(all().map(|s| s.seconds).collect()),
            seconds_worst: all().map(|s| s.seconds).reduce(f64::max),
            failures: share(all().map(|s| s.failure.is_some())),
        }
    }

    /// The goals that are missed, one line each.
    pub(crate) fn missed(&self, times_advisory: bool) -> Vec<String> {
        GOALS
            .iter()
            .filter(|g| !(times_advisory && g.is_time()))
            .filter_map(|g| {
                let x = (g.get)(self)?;
                (!(g.low..=g.high).contains(&x))
                    .then(|| format!("{}: {} (goal {})", g.what, (g.shown)(x), g.wanted()))
            })
            .collect()
    }
}

/// The figures below which a fixed suite must not fall.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Floors {
    /// What the file is for, to readers.
    #[serde(default)]
    pub(crate) about: String,
    /// Seed of the suite.
    pub(crate) seed: u64,
    /// Number of its cases.
    pub(crate) count: usize,
    /// Least values, by the names of the figures.
    #[serde(default)]
    pub(crate) at_least: BTreeMap<String, f64>,
    /// Greatest values.
    #[serde(default)]
    pub(crate) at_most: BTreeMap<String, f64>,
}

impl Floors {
    /// Reads a file of floors.
    ///
    /// # Errors
    /// When it cannot be read, is not of this form, or names a figure that does not exist.
    pub(crate) fn read(path: &Path) -> Result<Floors> {
        let text =
            std::fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
        let floors: Floors = serde_json::from_str(&text).with_context(|| format!("{}", path.display()))?;
        for name in floors.at_least.keys().chain(floors.at_most.keys()) {
            if !GOALS.iter().any(|g| g.name == name) {
                let known: Vec<&str> = GOALS.iter().map(|g| g.name).collect();
                anyhow::bail!(
                    "{}: no figure is called `{name}`; there are {}",
                    path.display(),
                    known.join(", ")
                );
            }
        }
        Ok(floors)
    }

    /// The figures below their floor, or above their ceiling. One that no case tells is below.
    pub(crate) fn missed(&self, figures: &Figures) -> Vec<String> {
        GOALS
            .iter()
            .filter_map(|g| {
                let x = (g.get)(figures);
                let shown = x.map_or("not measured".to_owned(), |x| (g.shown)(x));
                let low = self.at_least.get(g.name).filter(|&&low| !x.is_some_and(|x| x >= low));
                let high = self.at_most.get(g.name).filter(|&&high| !x.is_some_and(|x| x <= high));
                let bound = low
                    .map(|l| format!("floor {}", (g.shown)(*l)))
                    .or_else(|| high.map(|h| format!("ceiling {}", (g.shown)(*h))))?;
                Some(format!("{}: {shown} ({bound})", g.what))
            })
            .collect()
    }
}

/// One line about a case.
pub(crate) fn line(f: &Finished) -> String {
    let (t, s) = (&f.truth, &f.score);
    let truth = if t.effects.is_empty() {
        "null".to_owned()
    } else {
        t.effects
            .iter()
            .map(|e| format!("{}@{} {:.1}", e.kind, e.equations.join("+"), e.severity))
            .collect::<Vec<_>>()
            .join(" & ")
    };
    let said = match &s.failure {
        Some(why) => format!("FAILED {why}"),
        None if s.found.is_empty() => s.verdict.clone(),
        None => format!("{}: {}", s.verdict, s.found.join(", ")),
    };
    let masks: Vec<&str> = t.masks.iter().map(|m| m.name()).collect();
    let mark = if s.right() { "ok  " } else { "MISS" };
    let held = s.holdout.map_or("-".to_owned(), |r| format!("{r:.2}"));
    format!(
        "{mark} {:>3} {} {} [{}] {truth} -> {said} | held-out/oracle {held} | {:.1} s",
        t.index,
        t.id,
        t.system,
        masks.join(" "),
        s.seconds
    )
}

/// A row of counts for a group of cases.
fn row(name: &str, group: &[&Finished]) -> String {
    let shares = |get: &dyn Fn(&Finished) -> Option<bool>| {
        let known: Vec<bool> = group.iter().filter_map(|f| get(f)).collect();
        if known.is_empty() {
            return "-".to_owned();
        }
        format!("{}/{}", known.iter().filter(|k| **k).count(), known.len())
    };
    let effect = |f: &Finished| f.truth.class == "effect";
    format!(
        "{name:<32} {:>5} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}\n",
        group.len(),
        shares(&|f| (f.truth.class != "null").then_some(f.score.detected)),
        shares(&|f| f.score.exact),
        shares(&|f| f.score.family),
        shares(&|f| f.score.equation),
        shares(&|f| Some(is_near(f))),
        shares(&|f| effect(f).then_some(f.score.right()).or(Some(f.score.right()))),
    )
}

/// Of the laws that the library has no name for: how each was answered, case by case.
fn outside(finished: &[Finished]) -> String {
    let mut cases: Vec<&Finished> = finished.iter().filter(|f| f.truth.class == "outside").collect();
    if cases.is_empty() {
        return String::new();
    }
    let kind = |f: &Finished| f.truth.effects.first().map_or("", |e| e.kind);
    cases.sort_by_key(|f| (kind(f), f.truth.index));
    let mut text = format!(
        "{:<32} {:<12} {:<8} {:<8} {:>11}  {}\n",
        "outside, by law", "system", "honest", "term", "held-out", "answer"
    );
    for f in cases {
        let shown = |flag: Option<bool>| flag.map_or("-", |yes| if yes { "yes" } else { "no" });
        let (honest, term) = (shown(f.score.outside), shown(f.score.term));
        let held = f.score.holdout.map_or("-".to_owned(), |r| format!("{r:.2}"));
        let answer = f.score.answer.as_deref().unwrap_or("failed");
        let _ = writeln!(
            text,
            "{:<32} {:<12} {honest:<8} {term:<8} {held:>11}  {answer}",
            kind(f).trim_start_matches("outside_"),
            f.truth.system
        );
    }
    text.push('\n');
    text
}

/// The tables.
pub(crate) fn render(finished: &[Finished], figures: &Figures) -> String {
    let head = format!(
        "{:<32} {:>5} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}\n",
        "", "cases", "detected", "exact", "family", "equation", "held-out", "right"
    );
    let mut text = String::from("\n");
    let mut section = |title: &str, groups: BTreeMap<String, Vec<&Finished>>| {
        text.push_str(&head.replacen(&" ".repeat(title.len()), title, 1));
        for (name, group) in groups {
            text.push_str(&row(&name, &group));
        }
        text.push('\n');
    };
    let group_by = |names: &dyn Fn(&Finished) -> Vec<String>| {
        let mut groups: BTreeMap<String, Vec<&Finished>> = BTreeMap::new();
        for f in finished {
            for name in names(f) {
                groups.entry(name).or_default().push(f);
            }
        }
        groups
    };
    section(
        "by kind",
        group_by(&|f| f.truth.effects.first().map_or(vec!["null".into()], |e| vec![e.kind.to_owned()])),
    );
    section("by masking", group_by(&|f| f.truth.masks.iter().map(|m| m.name().to_owned()).collect()));
    section("by tier", group_by(&|f| vec![f.truth.tier.map_or("null".to_owned(), |t| t.name().to_owned())]));
    section("by system", group_by(&|f| vec![f.truth.system.to_owned()]));
    section("by class", group_by(&|f| vec![f.truth.class.to_owned()]));
    text.push_str(&outside(finished));
    text.push_str(&calibration(finished));
    for f in finished.iter().filter(|f| f.score.failure.is_some()) {
        let _ = writeln!(text, "failed: {} {}", f.truth.id, f.score.failure.as_deref().unwrap_or_default());
    }
    for g in &GOALS {
        let Some(x) = (g.get)(figures) else { continue };
        let mark = if (g.low..=g.high).contains(&x) { "met" } else { "MISSED" };
        let _ = writeln!(text, "{:<38} {:>9}   goal {:<18} {mark}", g.what, (g.shown)(x), g.wanted());
    }
    text
}

/// Confidence against truth.
fn calibration(finished: &[Finished]) -> String {
    let mut text = String::from("confidence of the first mechanism   cases   right\n");
    for (low, high) in [(0.0, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 0.97), (0.97, 1.01)] {
        let inside: Vec<bool> = finished
            .iter()
            .filter_map(|f| f.score.confidence)
            .filter(|(c, _)| (low..high).contains(c))
            .map(|(_, right)| right)
            .collect();
        let right = share(inside.iter().copied()).map_or("-".to_owned(), percent);
        let _ = writeln!(
            text,
            "{:<35} {:>5} {right:>7}",
            format!("{low:.2} to {:.2}", f64::min(high, 1.0)),
            inside.len()
        );
    }
    text.push('\n');
    text
}

/// Greybox beside the baseline method, on the cases of which the baseline can say anything.
pub(crate) fn render_baseline(finished: &[Finished]) -> String {
    let both: Vec<(&Finished, &Verdict)> =
        finished.iter().filter_map(|f| f.baseline.as_ref().map(|r| (f, r))).collect();
    let of = |class: &'static str| both.iter().filter(move |(f, _)| f.truth.class == class);
    let family = |f: &Finished, r: &Verdict| {
        r.kind.and_then(Kind::family_of).is_some_and(|x| f.truth.effects.iter().any(|e| e.family == x))
    };
    let place = |f: &Finished, r: &Verdict| {
        let named = r.equation.as_ref();
        named.is_some_and(|e| f.truth.effects.iter().any(|t| t.equations.contains(e)))
    };
    // Of several effects the baseline need name only one.
    let kind = |f: &Finished, r: &Verdict| {
        let fits = |e: &TruthEffect, k: &str| e.kind == k || e.twins.contains(&k);
        r.kind.is_some_and(|k| f.truth.effects.iter().any(|e| fits(e, k)))
    };
    let mut text = format!(
        "{:<38} {:>9} {:>9}   on the {} cases with every state measured\n",
        "",
        "greybox",
        "baseline",
        both.len()
    );
    let mut line = |what: &str, ours: Option<f64>, theirs: Option<f64>| {
        let shown = |x: Option<f64>| x.map_or("-".to_owned(), percent);
        let _ = writeln!(text, "{what:<38} {:>9} {:>9}", shown(ours), shown(theirs));
    };
    line(
        "effects detected",
        share(of("effect").map(|(f, _)| f.score.detected)),
        share(of("effect").map(|(_, r)| r.detected)),
    );
    line(
        "false alarms on nulls",
        share(of("null").map(|(f, _)| f.score.false_alarm)),
        share(of("null").map(|(_, r)| r.detected)),
    );
    line(
        "kind right",
        share(of("effect").filter_map(|(f, _)| f.score.exact)),
        share(of("effect").map(|(f, r)| kind(f, r))),
    );
    line(
        "family right",
        share(of("effect").filter_map(|(f, _)| f.score.family)),
        share(of("effect").map(|(f, r)| kind(f, r) || family(f, r))),
    );
    line(
        "equation right",
        share(of("effect").filter_map(|(f, _)| f.score.equation)),
        share(of("effect").map(|(f, r)| place(f, r))),
    );
    line(
        "outside: noticed, and no kind named",
        share(of("outside").filter_map(|(f, _)| f.score.outside)),
        share(of("outside").map(|(_, r)| r.detected && r.kind.is_none())),
    );
    text.push_str("held-out error of the baseline: none, its terms are not a simulation\n\n");
    text
}

/// Everything, per case and in all.
pub(crate) fn to_json(seed: u64, finished: &[Finished], figures: &Figures) -> serde_json::Value {
    let cases: Vec<_> = finished
        .iter()
        .map(|f| json!({"truth": f.truth, "score": f.score, "oracle": f.oracle, "baseline": f.baseline}))
        .collect();
    let goals: Vec<_> = GOALS
        .iter()
        .map(|g| {
            let x = (g.get)(figures);
            json!({"name": g.name, "what": g.what, "measured": x, "goal": g.wanted(),
                   "met": x.map(|x| (g.low..=g.high).contains(&x))})
        })
        .collect();
    json!({"seed": seed, "figures": figures, "goals": goals, "cases": cases})
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_floor_is_missed_below_it_and_where_nothing_was_measured() {
        let floors = Floors {
            about: String::new(),
            seed: 1,
            count: 2,
            at_least: BTreeMap::from([("detected".to_owned(), 0.9), ("location".to_owned(), 0.5)]),
            at_most: BTreeMap::from([("false_alarms".to_owned(), 0.0)]),
        };
        let figures = Figures { detected: Some(0.95), false_alarms: Some(0.1), ..Figures::default() };
        assert_eq!(
            floors.missed(&figures),
            [
                "false alarms on nulls: 10.0 % (ceiling 0.0 %)",
                "median overlap of windows: not measured (floor 0.500)"
            ]
        );
    }

    #[test]
    fn the_fixed_suite_names_figures_that_exist() {
        let path = greybox_dev::root().join("fixtures").join("concealed").join("floors.json");
        assert!(Floors::read(&path).unwrap().count > 0);
    }

    #[test]
    fn goals_are_missed_outside_their_bounds_only() {
        let figures = Figures {
            coverage: Some(0.99),
            exact: Some(0.9),
            seconds_worst: Some(500.0),
            ..Figures::default()
        };
        assert_eq!(
            figures.missed(true),
            ["95 % intervals that hold the truth: 99.0 % (goal 90.0 % to 98.0 %)"]
        );
        assert_eq!(figures.missed(false).len(), 2);
    }

    #[test]
    fn medians_and_shares() {
        assert_eq!(median(vec![3.0, 1.0, 2.0, 10.0]), Some(2.5));
        assert_eq!(median(vec![]), None);
        assert_eq!(share([true, false, true, true].into_iter()), Some(0.75));
        assert_eq!(share(std::iter::empty()), None);
    }
}
