//! `greybox calibrate`: the same equations with refitted parameters.

use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use greybox_calibrate::{Data, Fit, Level, Limits, Point, Score, Setup, free_parameters};
use greybox_model::{Model, WriteOptions};
use greybox_recording::{Recording, Severity};
use greybox_report::contract::{self, FitSet, Interval, ModelId, Ordered, Parameter, Producer};
use serde::Serialize;

use crate::answer::Answer;
use crate::commands::check::check_for_model;
use crate::commands::simulate::window;
use crate::failure::Failure;
use crate::loading;
use crate::output::OutputFolder;
use crate::progress::Progress;
use crate::story;

/// Refit the parameters of a model, its equations unchanged, with uncertainties
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox calibrate link.toml run1.csv run2.csv --holdout run3.csv --out calibrated

DIR receives model.toml (the model with the new values, comments kept) and report.json. Parameters with
`fixed = true` stay; `std` is a prior. With no --holdout, the last fifth of each recording is held out.")]
pub(crate) struct Arguments {
    /// Model (TOML)
    #[arg(value_name = "MODEL.toml")]
    model: PathBuf,

    /// Recordings to fit (CSV)
    #[arg(value_name = "TRAIN.csv", required = true)]
    train: Vec<PathBuf>,

    /// Recordings that only judge the result
    #[arg(long, value_name = "TEST.csv", num_args = 1..)]
    holdout: Vec<PathBuf>,

    /// Folder for the results; made where it is missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Share of each recording that is held out where no recording is.
const HELD_OUT: f64 = 0.2;
/// Number of segments of the successive fits: short ones first, whose problem is nearly convex; whole
/// pieces last, which hold the parameters best.
const LEVELS: [usize; 4] = [60, 15, 4, 1];

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
    let loaded = loading::model(&arguments.model)?;
    let (train, holdout) = loading::train_and_holdout(&arguments.train, &arguments.holdout)?;
    let model = &loaded.model;
    // The whole recordings first, so that a missing channel is not blamed on a part.
    Data::new(model, &train)?;
    let findings = findings(model, train.iter().chain(&holdout));
    let (train, holdout, source) = hold_out(train, holdout)?;
    let train = Arc::new(Data::new(model, &train)?);
    let holdout = Arc::new(Data::new(model, &holdout)?);
    let free = free_parameters(model);
    if free.is_empty() {
        return Err(Failure::file(
            &arguments.model,
            "every parameter is fixed, so there is nothing to calibrate",
        )
        .mend("take `fixed = true` from the parameters that may move"));
    }
    let out = OutputFolder::prepare(&arguments.out)?;

    let compile = |data: &Arc<Data>, free| {
        Setup::new(model, data.clone(), free).map_err(|e| Failure::file(&arguments.model, e))
    };
    let setup = compile(&train, free)?;
    let held = Setup { method: setup.method, ..compile(&holdout, Vec::new())? };
    let progress = Progress::steps(LEVELS.len() as u64 + 1);
    let refitted = refit(&setup, &progress);
    progress.stage("simulating whole recordings");
    let nominal = setup.values();
    let window_s = window(&train);
    let fit_set = |setup: &Setup| FitSet {
        nominal: scores(setup, &nominal, &refitted.scale, window_s),
        calibrated: scores(setup, &refitted.parameters, &refitted.scale, window_s),
        improved: Ordered::new(),
    };
    let report = Report {
        greybox: Producer { version: env!("CARGO_PKG_VERSION").to_owned(), seed: 0 },
        model: ModelId { name: model.name.clone(), file: loaded.file.clone() },
        parameters: parameters(model, &refitted),
        fit: contract::Fit {
            train: fit_set(&setup),
            holdout: fit_set(&held),
            window_s: Some(window_s),
            holdout_source: source,
            recordings: Ordered::new(),
        },
        noise_floor: train
            .channels
            .iter()
            .zip(train.sigma.iter().zip(&train.spread))
            .map(|(c, (sigma, spread))| (c.name.clone(), sigma / spread))
            .collect(),
        findings,
    };
    drop(progress);

    let mut calibrated = model.clone();
    for (parameter, value) in calibrated.parameters.iter_mut().zip(&refitted.parameters) {
        parameter.value = *value;
    }
    let toml = calibrated.to_toml(&WriteOptions { original: Some(&loaded.text), ..Default::default() });
    let json = serde_json::to_value(&report).map_err(|e| Failure::internal(format!("report.json: {e}")))?;
    out.write(&[("model.toml", toml.as_bytes()), ("report.json", format!("{json:#}\n").as_bytes())])?;
    Ok(Answer::new(in_words(arguments, &report), json))
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

/// Training part, held-out part, and where the latter came from.
fn hold_out(
    train: Vec<Recording>,
    holdout: Vec<Recording>,
) -> Result<(Vec<Recording>, Vec<Recording>, String), Failure> {
    if !holdout.is_empty() {
        let names: Vec<&str> = holdout.iter().map(|r| r.name.as_str()).collect();
        let source = format!("held-out recordings: {}", names.join(", "));
        return Ok((train, holdout, source));
    }
    let (head, tail) = Data::split_tail(&train, HELD_OUT);
    if head.is_empty() {
        return Err(Failure::input("the recordings are too short to hold out their last fifth")
            .mend("record for longer, or name a recording after `--holdout`"));
    }
    Ok((head, tail, "the last fifth of each training recording".to_owned()))
}

/// The result of the fits.
struct Refitted {
    parameters: Vec<f64>,
    /// Residual scale per channel, SI.
    scale: Vec<f64>,
}

/// Fits on short segments first and on whole pieces last.
fn refit(setup: &Setup, progress: &Progress) -> Refitted {
    let data = &setup.data;
    let mut scale: Vec<f64> = data.spread.iter().map(|s| s.max(f64::MIN_POSITIVE)).collect();
    let values = setup.values();
    let mut best: Option<(f64, Refitted)> = None;
    let mut last: Option<(Level, Fit)> = None;
    for count in LEVELS {
        let level = setup.level(count);
        progress.stage(format!("fitting {} segments", level.segments.len()));
        if last.as_ref().is_some_and(|(l, _)| l.segments == level.segments) {
            progress.advance();
            continue;
        }
        let points = match &last {
            None => vec![Point { parameters: values.clone(), starts: setup.starts(&level, &values) }],
            Some((from, fit)) => {
                let parameters = fit.point.parameters.clone();
                let starts = setup.starts(&level, &parameters);
                vec![setup.stitch(from, &fit.point, &level, &scale), Point { parameters, starts }]
            }
        };
        let rough = setup.fit(&level, &scale, &points, Limits::default());
        scale = residual_scale(&rough, &scale, &data.sigma);
        let fit = setup.fit(&level, &scale, &[rough.point], Limits::default());
        let error = free_run_error(setup, &fit.point.parameters, &scale);
        if best.as_ref().is_none_or(|(least, _)| error <= *least || least.is_nan()) {
            best = Some((error, Refitted { parameters: fit.point.parameters.clone(), scale: scale.clone() }));
        }
        last = Some((level, fit));
        progress.advance();
    }
    best.map_or(Refitted { parameters: values, scale }, |(_, refitted)| refitted)
}

/// The model's own residual per channel, never below 0.7 of the noise.
fn residual_scale(fit: &Fit, scale: &[f64], sigma: &[f64]) -> Vec<f64> {
    let rms = fit.rss.iter().zip(&fit.count).map(|(rss, n)| (rss / (*n).max(1) as f64).sqrt());
    rms.zip(scale).zip(sigma).map(|((r, scale), sigma)| (r * scale).max(0.7 * sigma)).collect()
}

/// Σ nrmse² over the channels in free run on the training data.
fn free_run_error(setup: &Setup, parameters: &[f64], scale: &[f64]) -> f64 {
    let run = setup.free_run(parameters, scale);
    setup.scores(&run, parameters, window(&setup.data), None).iter().map(|s| s.nrmse.powi(2)).sum()
}

fn scores(setup: &Setup, parameters: &[f64], scale: &[f64], window_s: f64) -> Ordered<contract::Score> {
    let run = setup.free_run(parameters, scale);
    let scores = setup.scores(&run, parameters, window_s, None);
    let score = |s: &Score, factor: f64| contract::Score {
        nrmse: s.nrmse,
        rmse: Some(s.rmse / factor).filter(|v| v.is_finite()),
        nrmse_windowed: Some(s.nrmse_windowed).filter(|v| v.is_finite()),
        rmse_windowed: Some(s.rmse_windowed / factor).filter(|v| v.is_finite()),
    };
    setup.data.channels.iter().zip(&scores).map(|(c, s)| (c.name.clone(), score(s, c.factor))).collect()
}

/// The parameters before and after, in the units of the model file.
fn parameters(model: &Model, refitted: &Refitted) -> Ordered<Parameter> {
    model
        .parameters
        .iter()
        .zip(&refitted.parameters)
        .map(|(p, value)| {
            let factor = p.unit.as_ref().map_or(1.0, |u| u.factor);
            let parameter = Parameter {
                nominal: p.value / factor,
                value: value / factor,
                ci95: None::<Interval>,
                unit: p.unit.as_ref().map(|u| u.text.clone()),
                fixed: p.fixed,
                calibrated: None,
                calibrated_ci95: None,
            };
            (p.name.clone(), parameter)
        })
        .collect()
}

fn in_words(arguments: &Arguments, report: &Report) -> String {
    format!(
        "{}{}{}Written: {out}/model.toml, {out}/report.json\n",
        story::parameter_table(&report.parameters),
        story::fit_table(&report.fit, &report.noise_floor),
        story::notes(&report.findings),
        out = arguments.out.display()
    )
}
