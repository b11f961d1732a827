//! `greybox compare`: what changed from one diagnosis to another.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use greybox_report::{Comparison, Report, ReportError};

use crate::answer::Answer;
use crate::failure::Failure;
use crate::loading;
use crate::output::OutputFolder;

/// The files of a comparison.
const FILES: [&str; 2] = ["comparison.json", "comparison.html"];

/// Hold two diagnoses against each other: before and after a repair, with another load, of another model
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox compare march april --out change
  greybox compare expected.json result --fail-if changed --fail-if worse

BEFORE and AFTER are folders that `greybox diagnose` wrote, or their report.json. With --out, the folder gets
comparison.json and comparison.html.

With --fail-if, for tests of a simulation against its machine, the exit status is 3 where one of the conditions holds.")]
pub(crate) struct Arguments {
    /// The earlier diagnosis
    #[arg(value_name = "BEFORE")]
    before: PathBuf,

    /// The later one
    #[arg(value_name = "AFTER")]
    after: PathBuf,

    /// Folder for the comparison; made where it is missing
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// Exit with status 3 where this holds; may be repeated
    #[arg(long, value_name = "CONDITION")]
    fail_if: Vec<Condition>,

    /// Growth of a held-out error, in percent of what it was, up to which it is not worse
    #[arg(long, value_name = "PERCENT", value_parser = percent, default_value_t = 10.0, allow_negative_numbers = true)]
    margin: f64,
}

/// What may be asked of the two runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Condition {
    /// Another verdict, a mechanism that is new or gone, or a parameter that changed by more than its intervals
    Changed,
    /// A held-out error of the improved model grew by more than the margin
    Worse,
}

impl Condition {
    /// What to say where it holds.
    fn met(self, comparison: &Comparison, margin: f64) -> Option<String> {
        match self {
            Condition::Changed => {
                comparison.is_changed().then(|| "the two runs conclude differently".to_owned())
            }
            Condition::Worse => comparison
                .is_worse(0.01 * margin)
                .then(|| format!("a held-out error grew by more than {margin} %, or is missing")),
        }
    }
}

fn percent(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|v: &f64| v.is_finite() && *v >= 0.0);
    value.ok_or_else(|| "write a number of percent from 0, such as 5".to_owned())
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let (before, after) = (read(&arguments.before)?, read(&arguments.after)?);
    let name = |path: &Path| path.display().to_string();
    let comparison = Comparison::of((&name(&arguments.before), &before), (&name(&arguments.after), &after));
    let unwritten = |e: ReportError| Failure::internal(e.to_string());
    let json = comparison.to_json().map_err(unwritten)?;
    if let Some(path) = &arguments.out {
        let out = OutputFolder::prepare(path)?;
        out.spares(&FILES, [&arguments.before, &arguments.after])?;
        let html = comparison.to_html().map_err(unwritten)?;
        out.write(&[(FILES[0], json.as_bytes()), (FILES[1], html.as_bytes())])?;
    }
    let mut text: String = comparison.summary.iter().map(|s| format!("{s}\n")).collect();
    for caution in &comparison.cautions {
        text.push_str(&format!("  caution: {caution}\n"));
    }
    if let Some(path) = &arguments.out {
        text.push_str(&format!("\n{}\n", path.join(FILES[1]).display()));
    }
    let json = serde_json::from_str(&json).map_err(|e| Failure::internal(e.to_string()))?;
    let met = arguments.fail_if.iter().filter_map(|c| c.met(&comparison, arguments.margin)).collect();
    Ok(Answer::new(text, json).failing(met))
}

/// The report of a folder, or of a file.
fn read(path: &Path) -> Result<Report, Failure> {
    let file = if path.is_dir() { path.join("report.json") } else { path.to_owned() };
    let help = "name a folder that `greybox diagnose` wrote, or its report.json";
    let text = loading::text(&file).map_err(|failure| failure.help(help))?;
    // (The file may have another name than the error says.)
    Report::from_json(&text).map_err(|error| match error {
        ReportError::Json(json) => Failure::file(&file, format!("not a diagnosis report: {json}")).help(help),
        newer => Failure::file(&file, newer.to_string())
            .help("update greybox, or read it with the version that wrote it"),
    })
}
