//! `cargo xtask prove`: greybox as a user runs it, on concealed cases or real recordings, against goals.
//!
//! Each case is one `greybox diagnose` as a process of its own; what it finds is read from its
//! `report.json`. Nothing here knows how greybox works.

// A command that measures: its answers go to standard output, its complaints to standard error.
#![allow(clippy::disallowed_methods, clippy::print_stdout, clippy::print_stderr)]

mod cases;
mod concealed;
mod identify;
mod runs;
pub(crate) mod sets;
pub(crate) mod statistics;
mod table;
mod watch;

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use serde_json::json;

use cases::Case;
use greybox_dev::{Ending, process};
use runs::Runs;

/// What `prove` takes.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Measure greybox on the real recordings of this folder instead of the concealed suite
    #[arg(long, value_name = "DIR")]
    recordings: Option<PathBuf>,
    /// Measure identification over seeds on virtual rigs instead
    #[arg(long)]
    identify: bool,
    /// Measure coverage, false alarms and the reliability of confidence over seeds instead
    #[arg(long, conflicts_with_all = ["recordings", "identify", "floors"])]
    statistics: bool,
    /// Measure delays, names and false alarms of `greybox watch` over seeds instead
    #[arg(long, conflicts_with_all = ["recordings", "identify", "statistics", "floors"])]
    watch: bool,
    /// Put what --statistics, --identify, --watch, or --recordings on the real sets, measured into the book
    #[arg(long)]
    write_docs: bool,
    /// Seed of the concealed suite; first seed of --identify, --statistics and --watch
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Cases of the concealed suite (three rounds of 42 otherwise); seeds per case of --identify, --statistics and --watch
    #[arg(long, value_name = "N")]
    count: Option<usize>,
    /// Keep the concealed suite's cases, truths and results here (target/prove/concealed otherwise), or the recordings of
    /// --identify's and --watch's machines
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Cases of the concealed suite, or with --times-advisory real recordings, that run at the same time
    #[arg(long, value_name = "N", default_value_t = 2)]
    jobs: usize,
    /// Beside greybox, judge what sparse regression of the missing acceleration says of the concealed suite
    #[arg(long)]
    baseline: bool,
    /// Fail only when a figure falls below its floor in this file, which also names the fixed suite of concealed cases;
    /// with --recordings, the floors of the real sets, and no case without a goal
    #[arg(long, value_name = "FILE")]
    floors: Option<PathBuf>,
    /// Write the figures as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Only the cases whose name contains this; of the concealed suite, those about all of these words (a
    /// kind, a masking, a tier, a system, a case's name, null, outside)
    #[arg(long, value_name = "WORDS")]
    only: Option<String>,
    /// Print the times without judging them (a shared machine proves nothing about speed)
    #[arg(long)]
    times_advisory: bool,
    /// Stop a run after this many seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 900)]
    timeout: u64,
}

/// One figure of a case.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Figure {
    /// What was measured.
    pub(crate) name: String,
    /// As text, with its unit.
    pub(crate) measured: String,
    /// As text; empty where there is none.
    pub(crate) goal: String,
    /// Whether the goal is met; `None` where there is none.
    pub(crate) met: Option<bool>,
}

impl Figure {
    /// A figure without a goal.
    pub(crate) fn plain(name: impl Into<String>, measured: impl Into<String>) -> Figure {
        Figure { name: name.into(), measured: measured.into(), goal: String::new(), met: None }
    }

    /// A figure with a goal.
    pub(crate) fn judged(
        name: impl Into<String>,
        measured: impl Into<String>,
        goal: impl Into<String>,
        met: bool,
    ) -> Figure {
        Figure { name: name.into(), measured: measured.into(), goal: goal.into(), met: Some(met) }
    }
}

/// A case with its figures.
#[derive(Debug, Clone)]
pub(crate) struct Outcome {
    /// Name of the case.
    pub(crate) case: String,
    /// Its figures.
    pub(crate) figures: Vec<Figure>,
}

/// Runs `prove`.
///
/// # Errors
/// When a recording is missing, greybox does not build, or a file cannot be written.
pub fn run(root: &Path, arguments: &Arguments) -> Result<Ending> {
    if arguments.write_docs && arguments.only.is_some() && !arguments.identify {
        bail!("--write-docs with --only would leave rows out of a table of the book");
    }
    if arguments.identify {
        if let Some(folder) = &arguments.keep {
            identify::keep(folder, arguments.seed, arguments.count)?;
        }
        let outcomes = identify::run(arguments.seed, arguments.count, arguments.only.as_deref())?;
        if arguments.write_docs {
            identify::write(root, &outcomes)?;
        }
        return conclude(&outcomes, arguments.json.as_deref());
    }
    if arguments.statistics {
        let found = statistics::run(arguments.seed, arguments.count, arguments.only.as_deref())?;
        if arguments.write_docs {
            statistics::write(root, &found)?;
        }
        return conclude(&found.outcomes, arguments.json.as_deref());
    }
    if arguments.watch {
        if let Some(folder) = &arguments.keep {
            watch::keep(folder, arguments.seed, arguments.count)?;
        }
        let outcomes = watch::run(arguments.seed, arguments.count, arguments.only.as_deref())?;
        if arguments.write_docs {
            watch::write(root, &outcomes)?;
        }
        return conclude(&outcomes, arguments.json.as_deref());
    }
    let folder = match &arguments.recordings {
        Some(given) if given.is_dir() => given.clone(),
        Some(given) => {
            bail!("there is no folder {}; --recordings names the real recordings", given.display())
        }
        None => return conceal(root, arguments),
    };
    let sets = sets::read(&folder)?;
    let only = arguments.only.as_deref();
    let known = |word: &str| sets.as_ref().is_some_and(|s| s.has(word));
    let mut cases = match only {
        // A word that names sets alone.
        Some(word) if known(word) && !cases::all().iter().any(|c| c.name.contains(word)) => Vec::new(),
        only => select(cases::all(), only)?,
    };
    // (What is only printed tells nothing to whom floors count.)
    if arguments.floors.is_some() {
        cases.retain(|c| c.has_goals);
    }
    if arguments.times_advisory {
        cases.iter_mut().for_each(|c| c.seconds = None);
    }
    for case in &cases {
        for file in case.files() {
            let path = folder.join(&case.folder).join(file);
            if !path.is_file() {
                bail!("{}: {} is missing", case.name, path.display());
            }
        }
    }
    let binary = process::build(root)?;
    let mut runs = Runs::new(&binary, Duration::from_secs(arguments.timeout));
    let out = process::target(root).join("prove");
    let sets_out = out.join("sets");
    // (Where times count, or stand in the book, each has the machine for itself.)
    if arguments.times_advisory && !arguments.write_docs {
        let of_cases = cases.iter().map(|case| (case.question(&folder), out.join(&case.name)));
        let of_sets = sets.iter().flat_map(|sets| sets.questions(&folder, &sets_out, only));
        runs.ask_ahead(of_cases.chain(of_sets).collect(), arguments.jobs)?;
    }
    let mut outcomes = Vec::new();
    for case in &cases {
        outcomes.push(measure(&mut runs, &folder, case, &out.join(&case.name))?);
    }
    if let Some(sets) = sets {
        let answers = sets::run(&sets, &folder, &mut runs, &sets_out, only)?;
        println!("{}", sets::text(&answers));
        let totals = sets::totals(&answers);
        let figures = match &arguments.floors {
            Some(path) => sets::judged(&totals, &sets::floors(path)?),
            None => sets::plain(&totals),
        };
        outcomes.push(Outcome { case: "real sets".to_owned(), figures });
        if arguments.write_docs {
            greybox_dev::book::put_table(root, sets::PAGE, sets::BEGIN, &sets::markdown(&answers))?;
        }
        if let Some(path) = &arguments.json {
            let json = json!({"cases": to_json(&outcomes)["cases"], "sets": answers, "totals": totals});
            return finish(&outcomes, Some((path, json)));
        }
    }
    conclude(&outcomes, arguments.json.as_deref())
}

/// Runs the concealed suite.
fn conceal(root: &Path, arguments: &Arguments) -> Result<Ending> {
    let folder =
        arguments.keep.clone().unwrap_or_else(|| process::target(root).join("prove").join("concealed"));
    std::fs::create_dir_all(&folder).with_context(|| format!("{} cannot be made", folder.display()))?;
    let options = concealed::Options {
        seed: arguments.seed,
        count: arguments.count,
        only: arguments.only.as_deref(),
        json: arguments.json.as_deref(),
        // Processes run elsewhere.
        folder: std::path::absolute(&folder)?,
        jobs: arguments.jobs,
        floors: arguments.floors.as_deref(),
        times_advisory: arguments.times_advisory,
        limit: Duration::from_secs(arguments.timeout),
        baseline: arguments.baseline,
    };
    concealed::run(&process::build(root)?, &options)
}

/// Prints the table, writes the JSON, and judges.
fn conclude(outcomes: &[Outcome], json: Option<&Path>) -> Result<Ending> {
    finish(outcomes, json.map(|path| (path, to_json(outcomes))))
}

fn finish(outcomes: &[Outcome], json: Option<(&Path, serde_json::Value)>) -> Result<Ending> {
    print!("{}", table::render(outcomes));
    if let Some((path, value)) = json {
        let text = serde_json::to_string_pretty(&value)? + "\n";
        std::fs::write(path, text).with_context(|| format!("{} cannot be written", path.display()))?;
    }
    let judged = outcomes.iter().flat_map(|o| &o.figures).filter_map(|f| f.met);
    let (met, all) = judged.fold((0, 0), |(met, all), m| (met + usize::from(m), all + 1));
    println!("{met} of {all} goals met.");
    Ok(if met == all { Ending::Done } else { Ending::Missed })
}

fn select(cases: Vec<Case>, only: Option<&str>) -> Result<Vec<Case>> {
    let Some(wanted) = only else { return Ok(cases) };
    let names: Vec<String> = cases.iter().map(|c| c.name.clone()).collect();
    let chosen: Vec<Case> = cases.into_iter().filter(|c| c.name.contains(wanted)).collect();
    if chosen.is_empty() {
        bail!("no case is called `{wanted}`; there are {}", names.join(", "));
    }
    Ok(chosen)
}

/// Runs one case; a run that fails is a figure like any other.
fn measure(runs: &mut Runs<'_>, folder: &Path, case: &Case, out: &Path) -> Result<Outcome> {
    let answered = runs.ask(&case.question(folder), out)?;
    let mut figures = match &answered.report {
        Ok(report) => (case.judge)(report),
        Err(why) => vec![Figure::judged("run", why, "a report", false)],
    };
    let run = &answered.run;
    let time = format!("{:.1} s", run.seconds);
    figures.push(match case.seconds {
        Some(most) => Figure::judged("time", time, format!("< {most} s"), run.seconds < most),
        None => Figure::plain("time", time),
    });
    // Below 1 MiB the reading dates from before the program was loaded.
    if let Some(bytes) = run.peak_bytes.filter(|&b| b >= 1 << 20) {
        figures.push(Figure::plain("peak memory", format!("{:.0} MiB", bytes as f64 / (1024.0 * 1024.0))));
    }
    Ok(Outcome { case: case.name.clone(), figures })
}

fn to_json(outcomes: &[Outcome]) -> serde_json::Value {
    let case = |o: &Outcome| {
        let figures: Vec<_> = o
            .figures
            .iter()
            .map(|f| json!({"name": f.name, "measured": f.measured, "goal": f.goal, "met": f.met}))
            .collect();
        json!({"case": o.case, "figures": figures})
    };
    json!({"cases": outcomes.iter().map(case).collect::<Vec<_>>()})
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cases_are_selected_by_part_of_their_name() {
        let chosen = select(cases::all(), Some("emps")).unwrap();
        assert_eq!(
            chosen.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(),
            ["emps_velocity", "emps_position"]
        );
        let error = select(cases::all(), Some("nothing")).err().unwrap().to_string();
        assert!(error.contains("silverbox") && error.contains("`nothing`"), "{error}");
    }

    /// A stand-in for greybox that copies a report, or fails.
    #[cfg(unix)]
    #[test]
    fn a_run_is_judged_by_its_report_and_its_failure_is_a_figure() {
        use std::os::unix::fs::PermissionsExt;
        let place = tempfile::tempdir().unwrap();
        let script = |name: &str, body: &str| {
            let path = place.path().join(name);
            std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
            path
        };
        let case = cases::all().into_iter().find(|c| c.name == "ball_bowling_ball").unwrap();
        let out = place.path().join("out");
        let go = |binary: PathBuf| {
            let mut runs = Runs::new(&binary, Duration::from_secs(20));
            measure(&mut runs, Path::new("here"), &case, &out).unwrap().figures
        };
        let report = cases::tests::report("consistent", &[], "z");
        std::fs::write(place.path().join("r.json"), report.to_json().unwrap()).unwrap();
        // The arguments come as a user would write them.
        let source = place.path().join("r.json");
        let good = go(script(
            "good",
            &format!(
                "[ \"$*\" = \"diagnose here/falling_balls/nominal.toml here/falling_balls/bowling_ball_drop1.csv \
                 --holdout here/falling_balls/bowling_ball_drop2.csv --out $7\" ] || exit 9\ncp {} $7/report.json",
                source.display()
            ),
        ));
        assert!(good.iter().all(|f| f.met != Some(false)), "{good:?}");
        assert!(good.iter().any(|f| f.met == Some(true)));
        let bad = go(script("bad", "echo 'error: no such channel' >&2; exit 2"));
        assert_eq!(bad[0].met, Some(false));
        assert!(bad[0].measured.contains("no such channel"), "{bad:?}");
        // The first run's report is gone.
        let silent = go(script("silent", "exit 0"));
        assert_eq!(silent[0].met, Some(false));
        assert!(silent[0].measured.contains("report.json"), "{silent:?}");
    }
}
