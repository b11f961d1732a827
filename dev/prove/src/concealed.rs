//! The concealed suite: machines with something left out, made from a seed, and how greybox does on them.
//!
//! A case is a folder with a nominal model and recordings under a name that says nothing; greybox runs on
//! it as a process. The truth stands in another folder, and is used only here, after the run.

mod baseline;
mod case;
mod gallery;
mod plan;
mod score;
mod summary;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use greybox_report::Report;

use self::case::{Case, Truth};
use self::plan::{Left, Slot};
use self::score::{Oracle, Score};
use super::runs;
use greybox_dev::{Ending, process};

/// Cases when `--count` does not say: three rounds.
const COUNT: usize = 3 * plan::ROUND;

/// What a run of the suite takes.
pub(crate) struct Options<'a> {
    pub(crate) seed: u64,
    pub(crate) count: Option<usize>,
    pub(crate) only: Option<&'a str>,
    pub(crate) json: Option<&'a Path>,
    /// Where everything is kept.
    pub(crate) folder: PathBuf,
    pub(crate) jobs: usize,
    pub(crate) floors: Option<&'a Path>,
    pub(crate) times_advisory: bool,
    pub(crate) limit: Duration,
    /// Whether the baseline method is judged as well.
    pub(crate) baseline: bool,
}

/// A case that was run.
pub(crate) struct Finished {
    pub(crate) truth: Truth,
    pub(crate) score: Score,
    pub(crate) oracle: Option<Oracle>,
    /// The nominal and the true model file, for the gallery.
    pub(crate) models: [String; 2],
    /// The held-out recording, channel by channel, for the gallery.
    pub(crate) curves: Vec<gallery::Curves>,
    /// What the baseline method says; absent where it was not asked or cannot say anything.
    pub(crate) baseline: Option<baseline::Verdict>,
}

/// Runs the suite.
///
/// # Errors
/// When a case cannot be made, a file cannot be written, or a process cannot be started.
pub(crate) fn run(binary: &Path, options: &Options<'_>) -> Result<Ending> {
    let floors = options.floors.map(summary::Floors::read).transpose()?;
    let (seed, count) = match &floors {
        Some(f) => (f.seed, options.count.unwrap_or(f.count)),
        None => (options.seed, options.count.unwrap_or(COUNT)),
    };
    for folder in ["cases", "truth", "out"] {
        let path = options.folder.join(folder);
        if path.exists() {
            std::fs::remove_dir_all(&path)
                .with_context(|| format!("{} cannot be emptied", path.display()))?;
        }
        std::fs::create_dir_all(&path).with_context(|| format!("{} cannot be made", path.display()))?;
    }
    let slots = plan::plan(seed, count);
    let finished = runs::in_order(&slots, options.jobs, |slot| one(binary, slot, options))?;
    let finished: Vec<Finished> = finished.into_iter().flatten().collect();
    if finished.is_empty() {
        bail!("no case is about `{}`", options.only.unwrap_or_default());
    }
    let verdicts = summary::Figures::of(&finished);
    print!("{}", summary::render(&finished, &verdicts));
    if options.baseline {
        print!("{}", summary::render_baseline(&finished));
    }
    put(&options.folder.join("gallery.html"), &gallery::render(seed, &finished, &verdicts))?;
    println!("gallery: {}\n", options.folder.join("gallery.html").display());
    if let Some(path) = options.json {
        let text = serde_json::to_string_pretty(&summary::to_json(seed, &finished, &verdicts))? + "\n";
        std::fs::write(path, text).with_context(|| format!("{} cannot be written", path.display()))?;
    }
    let missed = match &floors {
        Some(floors) => floors.missed(&verdicts),
        None => verdicts.missed(options.times_advisory),
    };
    for line in &missed {
        println!("MISSED {line}");
    }
    let asked = if floors.is_some() { "floors" } else { "goals" };
    println!("{} {asked} met.", if missed.is_empty() { "all" } else { "not all" });
    Ok(if missed.is_empty() { Ending::Done } else { Ending::Missed })
}

/// Makes, runs and judges the case of a slot; `None` where `--only` leaves it out.
fn one(binary: &Path, slot: &Slot, options: &Options<'_>) -> Result<Option<Finished>> {
    let id = slot.id();
    // Most are left out before anything is made.
    let kind = match slot.left {
        Left::Nothing => "null",
        Left::Effect(k) => k.name(),
    };
    let case = match case::make(slot) {
        Ok(case) => case,
        // The rest of the suite still tells.
        Err(why) => {
            println!("LEFT OUT {why:#}");
            return Ok(None);
        }
    };
    if let Some(words) = options.only {
        let about = describe(&case.truth, kind);
        if !words.split_whitespace().all(|w| about.split_whitespace().any(|a| a.contains(w))) {
            return Ok(None);
        }
    }
    let folder = options.folder.join("cases").join(&id);
    let truth_folder = options.folder.join("truth");
    let files = write(&case, &folder)?;
    let out = options.folder.join("out").join(&id);
    std::fs::create_dir_all(&out).with_context(|| format!("{} cannot be made", out.display()))?;

    let mut command = Command::new(binary);
    command.current_dir(&folder).arg("diagnose").arg("nominal.toml").args(&files[..files.len() - 1]);
    command.arg("--holdout").arg("holdout.csv").arg("--out").arg(&out);
    let run = process::run(&mut command, &out, options.limit)?;
    let report = runs::report_of(&run, &out);

    // Only now is the truth written down.
    let (nominal, truth_model) = (case.nominal_model(), case.true_model(false));
    let true_file = truth_folder.join(format!("{id}.toml"));
    put(&true_file, &truth_model)?;
    put(&truth_folder.join(format!("{id}.json")), &(serde_json::to_string_pretty(&case.truth)? + "\n"))?;
    let oracle = oracle(binary, &case, &out.join("oracle"), options.limit)?;
    let curves = match &report {
        Ok(report) => curves(binary, &case, report, &folder, &out, options.limit)?,
        Err(_) => Vec::new(),
    };
    let baseline = match &report {
        Ok(report) if options.baseline => {
            let named = case.machine.family.parameters().iter().zip(&case.nominal);
            let value = |name: &str| report.parameters.get(name).and_then(|p| p.calibrated);
            let calibrated: Vec<f64> = named.map(|(n, &p)| value(n.name).unwrap_or(p)).collect();
            baseline::judge(&case, &calibrated)
        }
        _ => None,
    };
    let score = match report {
        Ok(report) => score::judge(&case.truth, &report, oracle.as_ref(), run.seconds),
        Err(why) => Score::failed(&case.truth, why, run.seconds),
    };
    let finished =
        Finished { truth: case.truth, score, oracle, models: [nominal, truth_model], curves, baseline };
    println!("{}", summary::line(&finished));
    Ok(Some(finished))
}

/// Words by which `--only` selects.
fn describe(truth: &Truth, kind: &str) -> String {
    let masks: Vec<&str> = truth.masks.iter().map(|m| m.name()).collect();
    let effects: Vec<&str> = truth.effects.iter().map(|e| e.kind).collect();
    let tier = truth.tier.map_or("", |t| t.name());
    format!(
        "{kind} {} {} {} {tier} {} {}",
        truth.id,
        truth.class,
        truth.system,
        masks.join(" "),
        effects.join(" ")
    )
}

/// Writes what greybox is given; the names of the recordings, the held-out one last.
fn write(case: &Case, folder: &Path) -> Result<Vec<String>> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} cannot be made", folder.display()))?;
    put(&folder.join("nominal.toml"), &case.nominal_model())?;
    for recording in &case.recordings {
        put(&folder.join(&recording.name), &case.csv(recording, case.units))?;
    }
    Ok(case.recordings.iter().map(|r| r.name.clone()).collect())
}

fn put(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(|| format!("{} cannot be written", path.display()))
}

/// The file that `greybox simulate` writes; `None` where it fails.
fn simulate(
    binary: &Path,
    model: &Path,
    recording: &Path,
    logs: &Path,
    limit: Duration,
) -> Result<Option<String>> {
    std::fs::create_dir_all(logs).with_context(|| format!("{} cannot be made", logs.display()))?;
    let csv = logs.join("simulated.csv");
    let mut command = Command::new(binary);
    command.arg("simulate").arg(model).arg(recording).arg("--out").arg(&csv);
    let run = process::run(&mut command, logs, limit)?;
    if !run.status.is_some_and(|s| s.success()) {
        return Ok(None);
    }
    Ok(std::fs::read_to_string(&csv).ok())
}

/// The held-out errors of the true model; `None` where it could not be simulated.
///
/// By `greybox calibrate` with nothing left to calibrate: it estimates initial states and chooses windows as
/// `diagnose` does, so that the errors compare.
fn oracle(binary: &Path, case: &Case, folder: &Path, limit: Duration) -> Result<Option<Oracle>> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} cannot be made", folder.display()))?;
    put(&folder.join("model.toml"), &case.true_model(true))?;
    for recording in &case.recordings {
        put(&folder.join(&recording.name), &case.csv(recording, false))?;
    }
    let mut command = Command::new(binary);
    command.current_dir(folder).args(["calibrate", "model.toml"]).args(&case.truth.training);
    command.args(["--holdout", "holdout.csv", "--out", "result"]);
    let run = process::run(&mut command, folder, limit)?;
    if !run.status.is_some_and(|s| s.success()) {
        return Ok(None);
    }
    let text = std::fs::read_to_string(folder.join("result").join("report.json"))?;
    let value: serde_json::Value = serde_json::from_str(&text)?;
    let errors = value["fit"]["holdout"]["calibrated"].as_object().map(|fit| {
        fit.iter()
            .map(|(channel, s)| {
                (channel.clone(), s["nrmse"].as_f64().unwrap_or(f64::NAN), s["nrmse_windowed"].as_f64())
            })
            .collect()
    });
    Ok(errors.map(|errors| Oracle { errors }))
}

/// The held-out recording with the free runs of the calibrated and the improved model.
fn curves(
    binary: &Path,
    case: &Case,
    report: &Report,
    folder: &Path,
    out: &Path,
    limit: Duration,
) -> Result<Vec<gallery::Curves>> {
    let calibrated = out.join("calibrated.toml");
    put(&calibrated, &case.model_with(|name| report.parameters.get(name).and_then(|p| p.calibrated)))?;
    let holdout = folder.join("holdout.csv");
    let run = |model: &Path, logs: &str| -> Result<String> {
        Ok(simulate(binary, model, &holdout, &out.join(logs), limit)?.unwrap_or_default())
    };
    let (plain, improved) = (run(&calibrated, "calibrated")?, run(&out.join("improved.toml"), "improved")?);
    let names = case.machine.family.states();
    Ok((0..names.len())
        .filter(|&c| case.measured[c])
        .map(|c| gallery::Curves {
            channel: names[c].0.to_owned(),
            dt: case.dt,
            measured: case.held_out().shown[c].clone(),
            calibrated: gallery::column(&plain, names[c].0).unwrap_or_default(),
            improved: gallery::column(&improved, names[c].0).unwrap_or_default(),
        })
        .collect())
}
