//! `greybox diagnose`: what physics does the model leave out?

mod folder;

use std::path::{Path, PathBuf};

use clap::Args;
use greybox_diagnose::{Diagnosis, Options};
use greybox_recording::Recording;
use greybox_report::ReportError;
use greybox_report::convert::{self, Sources};

use crate::answer::Answer;
use crate::arguments::ModelStudy;
use crate::failure::Failure;
use crate::loading::{self, LoadedModel, Mechanisms};
use crate::output::OutputFolder;
use crate::progress::Progress;
use crate::story;

/// Find what physics a model leaves out: what, where, how sure, and a model that fits
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox diagnose link.toml run1.csv run2.csv --holdout run3.csv --out result
  greybox diagnose link.toml run1.csv --mechanisms mine --out result
  greybox diagnose link.toml run1.mat --map \"theta=sensor_3 [deg]\" --out result
  greybox diagnose link.toml recordings --out results

DIR receives report.json, report.html (self-contained, with plots) and improved.toml. With no --holdout, the
last fifth of each recording is held out. The same seed and inputs give the same results.

A folder in the place of TRAIN.csv stands alone: each of its recordings (*.csv, *.mat, *.parquet) that is not held out is diagnosed
by itself, into a folder of its own in DIR, and summary.html and summary.json say what all say together. A run that
was ended is gone on with by the same command: what is done is not done again.")]
pub(crate) struct Arguments {
    #[command(flatten)]
    inputs: ModelStudy,

    /// Seed of every random choice
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,

    /// Folder of mechanisms of your own (*.toml), tried beside the built-in ones
    #[arg(long, value_name = "DIR")]
    mechanisms: Option<PathBuf>,

    /// Most work of the search, in billions of operations; the report says when it was not enough
    #[arg(long, value_name = "N", default_value_t = Options::default().work / BILLION)]
    work: u64,
}

const BILLION: u64 = 1_000_000_000;

/// The files of a diagnosis.
const RESULTS: [&str; 3] = ["report.json", "report.html", "improved.toml"];

impl Arguments {
    fn options(&self, own: Option<&Mechanisms>) -> Options {
        Options {
            seed: self.seed,
            library: own.map(|o| o.library.mechanisms.clone()),
            work: self.work.saturating_mul(BILLION),
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let own = arguments.mechanisms.as_deref().map(loading::mechanisms).transpose()?;
    let train = &arguments.inputs.study.train;
    match (train.as_slice(), train.iter().find(|path| path.is_dir())) {
        ([alone], Some(_)) => return folder::run(arguments, alone, own.as_ref()),
        (_, Some(folder)) => {
            return Err(Failure::file(
                folder,
                "this is a folder, which stands alone as the place of recordings",
            )
            .mend("name the folder alone, or every recording by its own name"));
        }
        (_, None) => {}
    }
    let (loaded, recordings) = arguments.inputs.read()?;
    let out = arguments.inputs.folder(&RESULTS)?;
    out.spares(&RESULTS, own.iter().flat_map(|own| &own.files))?;
    let options = arguments.options(own.as_ref());
    let results = diagnose(&loaded, &recordings.train, &recordings.holdout, &options)?;
    results.write(&out)?;
    let tried = own.as_ref().map(tried).unwrap_or_default();
    let text = format!("{}{tried}\n{}", results.story, written(&arguments.inputs.study.out));
    Ok(Answer::new(text, results.json))
}

/// Which mechanisms beside the built-in ones were tried.
fn tried(own: &Mechanisms) -> String {
    let mut text = String::new();
    for (files, what) in [
        (&own.library.added, "tried beside the built-in mechanisms"),
        (&own.library.replaced, "tried in place of the built-in mechanism of the same name"),
    ] {
        if !files.is_empty() {
            text.push_str(&format!("Note: {what}: {}.\n", files.join(", ")));
        }
    }
    text
}

/// Where the results are.
pub(crate) fn written(out: &Path) -> String {
    format!("Written: {0}/report.html, {0}/report.json, {0}/improved.toml\n", out.display())
}

/// A diagnosis as the files and words that users see.
#[derive(Debug)]
pub(crate) struct Results {
    report_json: String,
    report_html: String,
    improved_toml: String,
    /// The diagnosis in plain language.
    pub(crate) story: String,
    /// The content of `report.json`.
    pub(crate) json: serde_json::Value,
}

impl Results {
    /// Writes all files, or none.
    ///
    /// # Errors
    /// As [`OutputFolder::write`].
    pub(crate) fn write(&self, out: &OutputFolder) -> Result<(), Failure> {
        self.write_with(out, &[])
    }

    /// Writes all files and `others`, or none.
    ///
    /// # Errors
    /// As [`OutputFolder::write`].
    pub(crate) fn write_with(&self, out: &OutputFolder, others: &[(&str, &[u8])]) -> Result<(), Failure> {
        out.write(&[&self.files(), others].concat())
    }

    /// The files, by name.
    fn files(&self) -> [(&'static str, &[u8]); 3] {
        let [json, html, toml] = RESULTS;
        [
            (json, self.report_json.as_bytes()),
            (html, self.report_html.as_bytes()),
            (toml, self.improved_toml.as_bytes()),
        ]
    }

    /// What is told of a finished diagnosis of these recordings.
    fn of(
        diagnosis: &Diagnosis,
        loaded: &LoadedModel,
        train: &[Recording],
        holdout: &[Recording],
    ) -> Result<Results, Failure> {
        let sources = Sources { model_file: &loaded.file, model_text: &loaded.text, train, holdout };
        let report = convert::report(diagnosis, &sources);
        let report_json = report.to_json().map_err(unwritten)?;
        let json = serde_json::from_str(&report_json).map_err(|e| unwritten(e.into()))?;
        let story = story::diagnosis(&report);
        let report_html = convert::page(diagnosis, report, &sources).to_html().map_err(unwritten)?;
        let improved_toml = convert::improved_toml(diagnosis, &loaded.text);
        Ok(Results { report_json, report_html, improved_toml, story, json })
    }
}

/// Diagnoses a model, with a progress bar for those who wait.
///
/// # Errors
/// Bad input where the recordings do not fit the model or hold too little data.
pub(crate) fn diagnose(
    loaded: &LoadedModel,
    train: &[Recording],
    holdout: &[Recording],
    options: &Options,
) -> Result<Results, Failure> {
    let progress = Progress::open();
    let diagnosis = greybox_diagnose::diagnose(&loaded.model, train, holdout, options, &progress)?;
    progress.stage("writing the report");
    Results::of(&diagnosis, loaded, train, holdout)
}

fn unwritten(error: ReportError) -> Failure {
    Failure::internal(error.to_string())
}
