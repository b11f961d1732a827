//! `greybox calibrate`: the same equations with refitted parameters.

use clap::Args;
use greybox_calibrate::{Data, Score};
use greybox_diagnose::Calibration;
use greybox_diagnose::diagnosis::ParameterChange;
use greybox_model::{Model, WriteOptions};
use greybox_recording::{Recording, Severity};
use greybox_report::contract::{self, FitSet, Interval, ModelId, Ordered, Parameter, Producer};
use serde::Serialize;

use crate::answer::Answer;
use crate::arguments::{ModelStudy, Recordings};
use crate::commands::check::check_for_model;
use crate::failure::Failure;
use crate::loading::LoadedModel;
use crate::progress::Progress;
use crate::story;

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

/// `report.json` of a calibration: the keys are those of a diagnosis, without its verdict.
#[derive(Debug, Serialize)]
struct Report {
    greybox: Producer,
    model: ModelId,
    parameters: Ordered<Parameter>,
    fit: contract::Fit,
    noise_floor: Ordered<f64>,
    findings: Vec<contract::Finding>,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let (loaded, recordings) = arguments.inputs.read()?;
    let model = &loaded.model;
    if model.parameters.iter().all(|p| p.fixed) {
        return Err(Failure::file(
            &arguments.inputs.model,
            "every parameter is fixed, so there is nothing to calibrate",
        )
        .mend("take `fixed = true` from the parameters that may move"));
    }
    let out = arguments.inputs.folder(&["model.toml", "report.json"])?;

    let progress = Progress::open();
    let Recordings { train, holdout } = &recordings;
    let calibration = greybox_diagnose::calibrate(model, train, holdout, &progress)?;
    drop(progress);
    let findings = findings(model, train.iter().chain(holdout));
    let report = report(&loaded, &calibration, findings);
    let options = WriteOptions { original: Some(&loaded.text), ..Default::default() };
    let toml = calibration.model.to_toml(&options);
    let json = serde_json::to_value(&report).map_err(|e| Failure::internal(format!("report.json: {e}")))?;
    out.write(&[("model.toml", toml.as_bytes()), ("report.json", format!("{json:#}\n").as_bytes())])?;
    Ok(Answer::new(in_words(arguments, &report), json))
}

fn report(loaded: &LoadedModel, calibration: &Calibration, findings: Vec<contract::Finding>) -> Report {
    let data = &calibration.data;
    let fit_set = |(nominal, calibrated): &(Vec<Score>, Vec<Score>)| FitSet {
        nominal: scores(data, nominal),
        calibrated: scores(data, calibrated),
        improved: Ordered::new(),
    };
    let floor = data.sigma.iter().zip(&data.spread).map(|(sigma, spread)| sigma / spread);
    Report {
        greybox: Producer { version: env!("CARGO_PKG_VERSION").to_owned(), seed: 0 },
        model: ModelId { name: loaded.model.name.clone(), file: loaded.file.clone() },
        parameters: parameters(&loaded.model, &calibration.parameters),
        fit: contract::Fit {
            train: fit_set(&calibration.train),
            holdout: fit_set(&calibration.holdout),
            window_s: Some(calibration.window),
            holdout_source: calibration.holdout_source.clone(),
            recordings: Ordered::new(),
        },
        noise_floor: data.channels.iter().map(|c| c.name.clone()).zip(floor).collect(),
        findings,
    }
}

/// Health findings of at least a warning.
fn findings<'a>(model: &Model, recordings: impl Iterator<Item = &'a Recording>) -> Vec<contract::Finding> {
    recordings
        .flat_map(|recording| {
            check_for_model(recording, model).into_iter().filter_map(|f| {
                let severity = match f.severity {
                    Severity::Info => return None,
                    Severity::Warning => contract::Severity::Warning,
                    Severity::Problem => contract::Severity::Error,
                };
                Some(contract::Finding {
                    severity,
                    code: f.code.to_owned(),
                    recording: Some(recording.name.clone()),
                    channel: f.channel,
                    message: f.message,
                    mend: f.mend,
                })
            })
        })
        .collect()
}

/// Scores by channel, in the units of the model.
fn scores(data: &Data, scores: &[Score]) -> Ordered<contract::Score> {
    let finite = |v: f64| Some(v).filter(|v| v.is_finite());
    let score = |s: &Score, factor: f64| contract::Score {
        nrmse: s.nrmse,
        rmse: finite(s.rmse / factor),
        nrmse_windowed: finite(s.nrmse_windowed),
        rmse_windowed: finite(s.rmse_windowed / factor),
    };
    data.channels.iter().zip(scores).map(|(c, s)| (c.name.clone(), score(s, c.factor))).collect()
}

/// The parameters before and after, in the units of the model file.
fn parameters(model: &Model, changes: &[ParameterChange]) -> Ordered<Parameter> {
    changes
        .iter()
        .filter_map(|change| {
            let p = model.parameters.get(change.index)?;
            let factor = p.unit.as_ref().map_or(1.0, |u| u.factor);
            let parameter = Parameter {
                nominal: change.nominal / factor,
                value: change.calibrated.value / factor,
                ci95: change.calibrated.ci95.map(|(low, high)| Interval::new(low / factor, high / factor)),
                unit: p.unit.as_ref().map(|u| u.text.clone()),
                fixed: p.fixed,
                calibrated: None,
                calibrated_ci95: None,
            };
            Some((p.name.clone(), parameter))
        })
        .collect()
}

fn in_words(arguments: &Arguments, report: &Report) -> String {
    format!(
        "{}{}{}Written: {out}/model.toml, {out}/report.json\n",
        story::parameter_table(&report.parameters),
        story::fit_table(&report.fit, &report.noise_floor),
        story::notes(&report.findings),
        out = arguments.inputs.study.out.display()
    )
}
