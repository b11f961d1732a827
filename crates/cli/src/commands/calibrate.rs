//! `greybox calibrate`: the same equations with refitted parameters.

use clap::Args;
use greybox_commands::calibrate::{FILES, Results, has_free_parameter};

use crate::answer::Answer;
use crate::case::Subject;
use crate::failure::Failure;
use crate::progress::Progress;
use crate::study::{ModelStudy, Recordings};

/// Refit the parameters of a model, its equations unchanged, with uncertainties
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox calibrate link.toml run1.csv run2.csv --holdout run3.csv --out calibrated
  greybox calibrate link.toml run1.mat --map \"theta=sensor_3 [deg]\" --out calibrated

DIR receives model.toml (the model with the new values, comments kept) and report.json. Parameters with
`fixed = true` stay; `std` is a prior. With no --holdout, the last fifth of each recording is held out.")]
pub(crate) struct Arguments {
    #[command(flatten)]
    inputs: ModelStudy,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let study = &arguments.inputs.study;
    let subject = Subject { model: Some(&arguments.inputs.model), ..study.subject(&FILES) };
    study.case.around(&subject, || work(arguments))
}

fn work(arguments: &Arguments) -> Result<Answer, Failure> {
    let (loaded, recordings) = arguments.inputs.read()?;
    has_free_parameter(&loaded)?;
    let out = arguments.inputs.folder(&FILES)?;

    let progress = Progress::open();
    let Recordings { train, holdout } = &recordings;
    let calibration = greybox_diagnose::calibrate(&loaded.model, train, holdout, &progress)
        .map_err(|e| Failure::diagnosis(&loaded.path, e))?;
    drop(progress);
    let results = Results::of(&calibration, &loaded, train, holdout)?;
    out.write(&results.files())?;
    let reported = arguments.inputs.study.out.display();
    let text = format!("{}Written: {reported}/model.toml, {reported}/report.json\n", results.story);
    Ok(Answer::new(text, results.json))
}
