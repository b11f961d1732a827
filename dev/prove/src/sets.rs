//! The real sets: how much of the gap between the calibrated model and the best physics fitted by hand a diagnosis
//! closes, whether its name is right, and whether what it hands back does harm.
//!
//! `reachable.json` beside the recordings tells what is reachable and which names are right. Only this scorer reads it.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use greybox_report::Report;
use greybox_report::contract::{Criterion, Mechanism, Ordered, Score, Verdict};
use serde::{Deserialize, Serialize};

use super::Figure;
use super::runs::{Question, Runs};

/// The file beside the recordings.
pub(crate) const FILE: &str = "reachable.json";
/// Page of the book with the table, and its marker there.
pub(crate) const PAGE: &str = "real-machines.md";
pub(crate) const BEGIN: &str =
    "<!-- Made by `cargo xtask prove --recordings DIR --write-docs`; do not edit. -->";

/// Ratio of calibrated to reachable error from which `consistent` does harm: something is there to be found.
const REACHABLE: f64 = 1.5;
/// Ratio of held-out errors by which named physics may be worse than the calibrated model.
const WORSE: f64 = 1.05;
/// Ratio of training errors that rounding may make.
const ROUNDING: f64 = 1e-6;

/// All sets of a folder.
#[derive(Debug, Deserialize)]
pub(crate) struct Sets {
    sets: Vec<Set>,
}

/// One model with its recordings.
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct Set {
    set: String,
    model: String,
    train: Vec<String>,
    holdout: Vec<String>,
    /// Held-out `nrmse` of the worst channel that a fit by hand reached; `None` where a free run tells nothing.
    reachable_nrmse: Option<f64>,
    /// Kinds of which one should be named first.
    right_first: Vec<String>,
    /// Whether `unexplained` is a right answer.
    unexplained_is_right_too: bool,
}

impl Sets {
    fn wanted(&self, only: Option<&str>) -> impl Iterator<Item = &Set> {
        self.sets.iter().filter(move |s| only.is_none_or(|w| s.name().contains(w)))
    }

    /// What is asked of the sets whose names contain `only`, and where the answers go.
    pub(crate) fn questions(
        &self,
        folder: &Path,
        out: &Path,
        only: Option<&str>,
    ) -> Vec<(Question, PathBuf)> {
        self.wanted(only).map(|set| set.question(folder, out)).collect()
    }

    /// Whether the name of a set contains this.
    pub(crate) fn has(&self, word: &str) -> bool {
        self.sets.iter().any(|s| s.name().contains(word))
    }
}

impl Set {
    fn name(&self) -> String {
        format!("{}/{}", self.set, self.model.trim_end_matches(".toml"))
    }

    fn question(&self, folder: &Path, out: &Path) -> (Question, PathBuf) {
        let question = Question::of(&folder.join(&self.set), &self.model, &self.train, &self.holdout);
        (question, out.join(self.name().replace('/', "-")))
    }
}

/// Harm that an answer does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Harm {
    /// `consistent` while a model with 1.5 times less error exists.
    ConsistentWhileReachable,
    /// The improved model fits the training recordings worse than the calibrated one.
    WorseInTraining,
    /// Named physics that is worse by 5 % on the held-out recordings.
    WorseHeldOut,
    /// A named mechanism whose strength is zero or not determined.
    Undetermined,
    /// The improved model diverges.
    Diverges,
    /// No report.
    Fails,
}

impl Harm {
    fn text(self) -> &'static str {
        match self {
            Harm::ConsistentWhileReachable => "consistent, more is reachable",
            Harm::WorseInTraining => "worse in training",
            Harm::WorseHeldOut => "worse held out",
            Harm::Undetermined => "strength not determined",
            Harm::Diverges => "diverges",
            Harm::Fails => "no report",
        }
    }
}

/// How greybox did on a set.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Answer {
    pub(crate) name: String,
    verdict: Option<String>,
    basis: Option<String>,
    /// Held-out error of the worst channel, by the criterion of the report.
    calibrated: Option<f64>,
    improved: Option<f64>,
    reachable: Option<f64>,
    windowed: bool,
    /// Share of ln(calibrated/reachable) that is closed.
    pub(crate) gap: Option<f64>,
    /// Kinds named, or proposed, in the order of the report.
    named: Vec<String>,
    proposed: Vec<String>,
    pub(crate) right: bool,
    pub(crate) harm: Vec<Harm>,
    seconds: f64,
    why: Option<String>,
}

/// What the totals must reach.
#[derive(Debug, Deserialize)]
pub(crate) struct Floors {
    /// Least median gap closed.
    median_gap: f64,
    /// Fewest right or honest answers.
    right: usize,
    /// Most harmful answers.
    harmful: usize,
}

/// Reads the sets of a folder; `None` where it has none.
pub(crate) fn read(folder: &Path) -> Result<Option<Sets>> {
    let path = folder.join(FILE);
    if !path.is_file() {
        return Ok(None);
    }
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
    let sets: Sets = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    for set in &sets.sets {
        for file in std::iter::once(&set.model).chain(&set.train).chain(&set.holdout) {
            let path = folder.join(&set.set).join(file);
            if !path.is_file() {
                bail!("{}: {} is missing", set.name(), path.display());
            }
        }
    }
    Ok(Some(sets))
}

/// Reads floors.
pub(crate) fn floors(path: &Path) -> Result<Floors> {
    let text = std::fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
    serde_json::from_str(&text).with_context(|| path.display().to_string())
}

/// Diagnoses the sets whose name contains `only`.
pub(crate) fn run(
    sets: &Sets,
    folder: &Path,
    runs: &mut Runs<'_>,
    out: &Path,
    only: Option<&str>,
) -> Result<Vec<Answer>> {
    let one = |set: &Set| {
        let (question, out) = set.question(folder, out);
        let answered = runs.ask(&question, &out)?;
        Ok(judge(set, answered.report.as_ref(), answered.run.seconds))
    };
    sets.wanted(only).map(one).collect()
}

/// The error of the worst channel by the report's criterion: infinite where a simulation diverges.
fn worst(scores: &Ordered<Score>, criterion: Criterion) -> f64 {
    scores.values().map(|s| error(s, criterion)).fold(0.0, f64::max)
}

fn error(score: &Score, criterion: Criterion) -> f64 {
    let value = match criterion {
        Criterion::FreeRun => score.nrmse,
        Criterion::Windowed => score.nrmse_windowed.unwrap_or(f64::NAN),
    };
    if value.is_nan() { f64::INFINITY } else { value }
}

fn judge(set: &Set, report: Result<&Report, &String>, seconds: f64) -> Answer {
    let kinds = |list: &[Mechanism]| list.iter().map(|m| m.kind.clone()).collect::<Vec<_>>();
    let report = match report {
        Ok(report) => report,
        Err(why) => {
            return Answer {
                name: set.name(),
                verdict: None,
                basis: None,
                calibrated: None,
                improved: None,
                reachable: set.reachable_nrmse,
                windowed: false,
                gap: set.reachable_nrmse.map(|_| 0.0),
                named: Vec::new(),
                proposed: Vec::new(),
                right: false,
                harm: vec![Harm::Fails],
                seconds,
                why: Some(why.clone()),
            };
        }
    };
    let criterion = report.fit.criterion;
    let (calibrated, improved) =
        (worst(&report.fit.holdout.calibrated, criterion), worst(&report.fit.holdout.improved, criterion));
    // What is reachable is stated for free runs.
    let gap = set.reachable_nrmse.and_then(|reachable| {
        let free = Criterion::FreeRun;
        gap(worst(&report.fit.holdout.calibrated, free), worst(&report.fit.holdout.improved, free), reachable)
    });
    let right = match report.verdict {
        Verdict::MissingPhysics => {
            report.mechanisms.first().is_some_and(|m| set.right_first.contains(&m.kind))
        }
        Verdict::Unexplained => set.unexplained_is_right_too,
        Verdict::Consistent => false,
    };
    let mut harm = Vec::new();
    let free = worst(&report.fit.holdout.calibrated, Criterion::FreeRun);
    let more = set.reachable_nrmse.is_some_and(|r| free > REACHABLE * r);
    if report.verdict == Verdict::Consistent && more {
        harm.push(Harm::ConsistentWhileReachable);
    }
    let squares = |scores| squares(scores, criterion);
    if squares(&report.fit.train.improved) > (1.0 + ROUNDING) * squares(&report.fit.train.calibrated) {
        harm.push(Harm::WorseInTraining);
    }
    if report.verdict == Verdict::MissingPhysics && improved > WORSE * calibrated {
        harm.push(Harm::WorseHeldOut);
    }
    if report.mechanisms.iter().any(is_undetermined) {
        harm.push(Harm::Undetermined);
    }
    if improved.is_infinite() && calibrated.is_finite() {
        harm.push(Harm::Diverges);
    }
    Answer {
        name: set.name(),
        verdict: word(report.verdict),
        basis: word(report.basis),
        calibrated: Some(calibrated),
        improved: Some(improved),
        reachable: set.reachable_nrmse,
        windowed: criterion == Criterion::Windowed,
        gap,
        named: kinds(&report.mechanisms),
        proposed: kinds(&report.candidates),
        right,
        harm,
        seconds,
        why: None,
    }
}

/// A word of the contract as it stands in the file.
fn word(of: impl Serialize) -> Option<String> {
    serde_json::to_value(of).ok()?.as_str().map(str::to_owned)
}

/// Sum over the channels of the squares of their errors, by which one model fits better than another.
fn squares(scores: &Ordered<Score>, criterion: Criterion) -> f64 {
    scores.values().map(|s| error(s, criterion).powi(2)).sum()
}

/// Share of ln(calibrated/reachable) that is closed; `None` where nothing is to be closed.
fn gap(calibrated: f64, improved: f64, reachable: f64) -> Option<f64> {
    if calibrated.partial_cmp(&reachable) != Some(std::cmp::Ordering::Greater) {
        return None;
    }
    match (calibrated.is_finite(), improved.is_finite()) {
        (true, true) => Some((calibrated / improved).ln() / (calibrated / reachable).ln()),
        (false, true) => Some(1.0),
        (_, false) => Some(f64::NEG_INFINITY),
    }
}

/// Whether the strength of a mechanism is zero, or the intervals of all its parameters hold zero.
fn is_undetermined(m: &Mechanism) -> bool {
    let known = m.parameters.values().filter(|p| p.ci95.is_some()).count();
    let holds_zero =
        |p: &greybox_report::contract::Estimate| p.ci95.is_some_and(|ci| ci.low <= 0.0 && ci.high >= 0.0);
    m.parameters.values().any(|p| p.value == 0.0)
        || (known > 0 && m.parameters.values().filter(|p| p.ci95.is_some()).all(holds_zero))
}

/// What all answers come to.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Totals {
    pub(crate) sets: usize,
    /// Sets whose reachable error is known.
    pub(crate) judged: usize,
    pub(crate) median_gap: f64,
    pub(crate) right: usize,
    pub(crate) harmful: usize,
    pub(crate) seconds: f64,
}

pub(crate) fn totals(answers: &[Answer]) -> Totals {
    let mut gaps: Vec<f64> = answers.iter().filter_map(|a| a.gap).collect();
    gaps.sort_by(f64::total_cmp);
    let middle = |i: usize| gaps.get(i).copied().unwrap_or(f64::NAN);
    let n = gaps.len();
    Totals {
        sets: answers.len(),
        judged: n,
        median_gap: if n == 0 { f64::NAN } else { 0.5 * (middle((n - 1) / 2) + middle(n / 2)) },
        right: answers.iter().filter(|a| a.right).count(),
        harmful: answers.iter().filter(|a| !a.harm.is_empty()).count(),
        seconds: answers.iter().map(|a| a.seconds).sum(),
    }
}

/// The totals against their floors.
pub(crate) fn judged(totals: &Totals, floors: &Floors) -> Vec<Figure> {
    let all = totals.sets;
    vec![
        Figure::judged(
            "median gap closed",
            format!("{:.2} of {} sets", totals.median_gap, totals.judged),
            format!("≥ {:.2}", floors.median_gap),
            totals.median_gap >= floors.median_gap,
        ),
        Figure::judged(
            "right or honest",
            format!("{} of {all}", totals.right),
            format!("≥ {}", floors.right),
            totals.right >= floors.right,
        ),
        Figure::judged(
            "harmful",
            format!("{} of {all}", totals.harmful),
            format!("≤ {}", floors.harmful),
            totals.harmful <= floors.harmful,
        ),
    ]
}

/// The totals without goals.
pub(crate) fn plain(totals: &Totals) -> Vec<Figure> {
    let nothing = Floors { median_gap: 0.0, right: 0, harmful: 0 };
    judged(totals, &nothing).into_iter().map(|f| Figure::plain(f.name, f.measured)).collect()
}

/// Heads of the table.
const HEADS: [&str; 9] =
    ["set", "calibrated", "reachable", "improved", "gap closed", "answer", "right", "harm", "s"];

fn cells(a: &Answer) -> [String; 9] {
    let percent = |v: Option<f64>| {
        v.map_or("–".to_owned(), |v| {
            if v.is_finite() { format!("{:.2} %", 100.0 * v) } else { "diverges".to_owned() }
        })
    };
    let mark = if a.windowed { " (windowed)" } else { "" };
    let kinds = |list: &[String]| list.iter().map(|k| k.replace('_', " ")).collect::<Vec<_>>().join(", ");
    let said = match (a.verdict.as_deref(), &a.why) {
        (Some("missing_physics"), _) => kinds(&a.named),
        (Some(verdict), _) if a.proposed.is_empty() => verdict.to_owned(),
        (Some(verdict), _) => format!("{verdict}; proposed: {}", kinds(&a.proposed)),
        (None, why) => why.clone().unwrap_or_default(),
    };
    [
        a.name.clone(),
        percent(a.calibrated) + mark,
        percent(a.reachable),
        percent(a.improved) + mark,
        a.gap.map_or("–".to_owned(), |g| format!("{g:.2}")),
        said,
        if a.right { "yes" } else { "no" }.to_owned(),
        a.harm.iter().map(|h| h.text()).collect::<Vec<_>>().join("; "),
        format!("{:.0}", a.seconds),
    ]
}

/// The table as text, in columns as wide as their widest cell.
pub(crate) fn text(answers: &[Answer]) -> String {
    let rows: Vec<[String; 9]> =
        std::iter::once(HEADS.map(str::to_owned)).chain(answers.iter().map(cells)).collect();
    let widths: Vec<usize> =
        (0..9).map(|c| rows.iter().map(|r| r[c].chars().count()).max().unwrap_or(0)).collect();
    let line = |row: &[String; 9]| {
        let padded: Vec<String> = row.iter().zip(&widths).map(|(cell, &w)| format!("{cell:<w$}")).collect();
        padded.join("  ").trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

/// The table for the book, without times, which differ from machine to machine.
pub(crate) fn markdown(answers: &[Answer]) -> String {
    let row = |cells: &[String; 9]| format!("| {} |\n", cells[..8].join(" | "));
    let t = totals(answers);
    let mut text = row(&HEADS.map(str::to_owned)) + "|---|--:|--:|--:|--:|---|---|---|\n";
    answers.iter().for_each(|a| text.push_str(&row(&cells(a))));
    text + &format!(
        "\nMedian gap closed {:.2} over {} sets; right or honest {} of {}; harmful {}.\n",
        t.median_gap, t.judged, t.right, t.sets, t.harmful
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cases::tests::report;

    #[test]
    fn the_page_has_the_markers_of_its_table() {
        assert!(greybox_dev::book::has_table(&greybox_dev::root(), PAGE, BEGIN));
    }

    fn set(reachable: Option<f64>) -> Set {
        Set {
            set: "cart".into(),
            model: "cart.toml".into(),
            train: vec!["a.csv".into()],
            holdout: vec!["b.csv".into()],
            reachable_nrmse: reachable,
            right_first: vec!["viscous_friction".into()],
            unexplained_is_right_too: false,
        }
    }

    /// A report whose held-out errors are these.
    fn answer(verdict: &str, kinds: &[&str], calibrated: f64, improved: f64) -> Report {
        let mut r = report(verdict, kinds, "x");
        for set in [&mut r.fit.train, &mut r.fit.holdout] {
            set.calibrated.insert("x".into(), score(calibrated));
            set.improved.insert("x".into(), score(improved));
        }
        r
    }

    fn score(nrmse: f64) -> Score {
        Score { nrmse, rmse: None, nrmse_windowed: Some(nrmse), rmse_windowed: None }
    }

    fn judge(set: &Set, report: Result<Report, String>, seconds: f64) -> Answer {
        super::judge(set, report.as_ref(), seconds)
    }

    #[test]
    fn a_right_answer_closes_the_gap() {
        let a =
            judge(&set(Some(0.01)), Ok(answer("missing_physics", &["viscous_friction"], 0.16, 0.02)), 1.0);
        assert!((a.gap.unwrap() - 0.75).abs() < 1e-12, "{a:?}");
        assert!(a.right && a.harm.is_empty(), "{a:?}");
        let other = judge(&set(Some(0.01)), Ok(answer("missing_physics", &["gravity"], 0.16, 0.02)), 1.0);
        assert!(!other.right && other.harm.is_empty(), "{other:?}");
    }

    #[test]
    fn every_harm_is_seen() {
        let harm = |r: Report| judge(&set(Some(0.1)), Ok(r), 1.0).harm;
        assert_eq!(harm(answer("consistent", &[], 0.2, 0.2)), [Harm::ConsistentWhileReachable]);
        assert_eq!(harm(answer("consistent", &[], 0.14, 0.14)), []);
        let mut worse = answer("missing_physics", &["gravity"], 0.2, 0.1);
        worse.fit.train.improved.insert("x".into(), score(0.21));
        assert_eq!(harm(worse), [Harm::WorseInTraining]);
        let mut held = answer("missing_physics", &["gravity"], 0.2, 0.1);
        held.fit.holdout.improved.insert("x".into(), score(0.22));
        assert_eq!(harm(held), [Harm::WorseHeldOut]);
        let mut lost = answer("unexplained", &[], 0.2, 0.1);
        lost.fit.holdout.improved.insert("x".into(), score(f64::NAN));
        assert_eq!(harm(lost), [Harm::Diverges]);
        let mut zero = answer("missing_physics", &["gravity"], 0.2, 0.1);
        let estimate = greybox_report::contract::Estimate { value: 0.0, ci95: None, unit: String::new() };
        zero.mechanisms[0].parameters.insert("mgl".into(), estimate);
        assert_eq!(harm(zero), [Harm::Undetermined]);
        assert_eq!(judge(&set(None), Err("panicked".into()), 1.0).harm, [Harm::Fails]);
    }

    #[test]
    fn totals_hold_the_median_and_the_counts() {
        let of = |improved| judge(&set(Some(0.01)), Ok(answer("unexplained", &[], 0.16, improved)), 2.0);
        let answers = [of(0.16), of(0.04), of(0.01)];
        let t = totals(&answers);
        assert!((t.median_gap - 0.5).abs() < 1e-12 && t.right == 0 && t.harmful == 0, "{t:?}");
        let floors = Floors { median_gap: 0.6, right: 0, harmful: 0 };
        let met: Vec<bool> = judged(&t, &floors).iter().filter_map(|f| f.met).collect();
        assert_eq!(met, [false, true, true]);
        assert!(text(&answers).contains("cart/cart"), "{}", text(&answers));
        assert!(!markdown(&answers).contains("diverges"));
    }
}
