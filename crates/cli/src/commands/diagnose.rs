//! `greybox diagnose`: what physics does the model leave out?

mod folder;

use std::path::{Path, PathBuf};

use clap::Args;
use greybox_commands::diagnose::{FILES, Results};
use greybox_diagnose::Options;
use greybox_recording::Recording;

use crate::answer::Answer;
use crate::case::Subject;
use crate::failure::Failure;
use crate::loading::{self, LoadedModel, Mechanisms};
use crate::progress::Progress;
use crate::study::{BILLION, ModelStudy, Study, whole};

/// Find what physics a model leaves out: what, where, how sure, and a model that fits
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox diagnose link.toml run1.csv run2.csv --holdout run3.csv --out result
  greybox diagnose link.toml run1.csv --mechanisms mine --out result
  greybox diagnose link.toml run1.mat --map \"theta=sensor_3 [deg]\" --out result
  greybox diagnose link.toml recordings --out results
  greybox diagnose link.toml recordings --runs runs.csv --out results
  greybox diagnose link.toml run1.csv --out result --save-case case

DIR receives report.json, report.html (self-contained, with plots) and improved.toml. With no --holdout, the
last fifth of each recording is held out. The same seed and inputs give the same results.

A folder in the place of TRAIN.csv stands alone: each of its recordings (*.csv, *.mat, *.h5, *.npz, *.mcap, *.parquet, …) that is not held out
is diagnosed by itself, into a folder of its own in DIR, and summary.html and summary.json say what all say together. The
same command resumes an interrupted run: what is done is not done again. With --runs they also say in which share of the
machines something is found, what each machine has of its own, what changes with date and temperature, and which machines
differ.

Something wrong? --save-case packs what another needs to see why, without one value of the recordings; with --with-data
they are in it, and it runs again by the command in its README.md.")]
pub(crate) struct Arguments {
    #[command(flatten)]
    inputs: ModelStudy,

    /// Seed of every random choice
    #[arg(long, value_name = "N", value_parser = whole, default_value_t = 0, allow_negative_numbers = true)]
    seed: u64,

    /// Folder of mechanisms of your own (*.toml), tried beside the built-in ones
    #[arg(long, value_name = "DIR")]
    mechanisms: Option<PathBuf>,

    /// Table of a folder's recordings (CSV): `recording`, `machine`, `date`, and covariates such as `temperature [degC]`
    #[arg(long, value_name = "RUNS.csv")]
    runs: Option<PathBuf>,

    /// Most work of the search, in billions of operations; the report says when it was not enough
    #[arg(long, value_name = "N", value_parser = whole, default_value_t = Options::default().work / BILLION, allow_negative_numbers = true)]
    work: u64,
}

impl Arguments {
    fn options(&self, own: Option<&Mechanisms>) -> Options {
        Options {
            seed: self.seed,
            library: own.map(|o| o.library.mechanisms.clone()),
            work: self.work.saturating_mul(BILLION),
            terms_only: false,
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let (study, mechanisms) = (&arguments.inputs.study, arguments.mechanisms.as_deref());
    let subject = Subject { model: Some(&arguments.inputs.model), mechanisms, ..study.subject(&FILES) };
    study.case.around(&subject, || work(arguments))
}

fn work(arguments: &Arguments) -> Result<Answer, Failure> {
    let own = arguments.mechanisms.as_deref().map(loading::mechanisms).transpose()?;
    let train = &arguments.inputs.study.train;
    match (train.as_slice(), train.iter().find(|path| path.is_dir())) {
        ([alone], Some(_)) => return folder::run(arguments, alone, own.as_ref()),
        (_, Some(folder)) => {
            return Err(Failure::file(
                folder,
                "this is a folder, which stands alone as the place of recordings",
            )
            .help("name the folder alone, or every recording by its own name"));
        }
        (_, None) => {}
    }
    if let Some(runs) = &arguments.runs {
        return Err(Failure::file(runs, "`--runs` tells of the recordings of a folder, but there is none")
            .help("name the folder that holds the recordings, or leave `--runs` out"));
    }
    let ModelStudy { model, study } = &arguments.inputs;
    let [.., improved] = FILES;
    answer(study, model, own.as_ref(), &arguments.options(own.as_ref()), improved)
}

/// Diagnoses a model on the recordings of a study, with these mechanisms beside the built-in ones, and writes the results,
/// the improved model under this name.
///
/// # Errors
/// Bad input, of whatever file, and a folder that cannot be written.
pub(crate) fn answer(
    study: &Study,
    model: &PathBuf,
    own: Option<&Mechanisms>,
    options: &Options,
    improved: &'static str,
) -> Result<Answer, Failure> {
    let (loaded, recordings) = study.read(model)?;
    let [json, html, _] = FILES;
    let inputs = std::iter::once(model).chain(own.iter().flat_map(|own| &own.files));
    let out = study.folder(&[json, html, improved], inputs)?;
    let results = diagnose(&loaded, &recordings.train, &recordings.holdout, options)?;
    let [json, html, (_, text)] = results.files();
    out.write(&[json, html, (improved, text)])?;
    let tried = own.map(tried).unwrap_or_default();
    let reported = format!("{}{tried}\n{}", results.story, written(&study.out, improved));
    Ok(Answer::new(reported, results.json))
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

/// Where the results are, the model under this name.
pub(crate) fn written(out: &Path, model: &str) -> String {
    format!("Written: {0}/report.html, {0}/report.json, {0}/{model}\n", out.display())
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
    let diagnosis = greybox_diagnose::diagnose(&loaded.model, train, holdout, options, &progress)
        .map_err(|e| Failure::diagnosis(&loaded.path, e))?;
    progress.stage("writing the report");
    Results::of(&diagnosis, loaded, train, holdout)
}
