//! A calibration as files and words.

use greybox_calibrate::{Score, Setup, input_noise};
use greybox_diagnose::Calibration;
use greybox_diagnose::diagnosis::ParameterChange;
use greybox_model::{Model, WriteOptions};
use greybox_recording::Recording;
use greybox_report::contract::{self, FitSet, Interval, ModelId, Ordered, Parameter, Producer};
use greybox_report::convert::{calibrated_recordings, health_finding, health_findings, held_out, scores};
use greybox_report::page;
use serde::Serialize;

use crate::failure::Failure;
use crate::loading::LoadedModel;
use crate::story;

/// The files of a calibration.
pub const FILES: [&str; 2] = ["model.toml", "report.json"];

/// A calibration as the files and words that users see.
#[derive(Debug)]
pub struct Results {
    /// `report.json`.
    pub report_json: String,
    /// `model.toml`.
    pub model_toml: String,
    /// The calibration in plain language.
    pub story: String,
    /// The content of `report.json`.
    pub json: serde_json::Value,
    /// The recordings beside the free runs of the nominal and the calibrated model.
    pub recordings: Vec<page::Recording>,
}

impl Results {
    /// What is reported of a finished calibration on these recordings.
    ///
    /// # Errors
    /// An internal failure where the report cannot be written.
    pub fn of(
        calibration: &Calibration,
        loaded: &LoadedModel,
        train: &[Recording],
        holdout: &[Recording],
    ) -> Result<Results, Failure> {
        let mut findings = health_findings(&loaded.model, train.iter().chain(holdout));
        findings.retain(|f| f.severity > contract::Severity::Info);
        findings.extend(input_noise(calibration));
        findings.extend(calibration.limited.then(limit));
        findings.extend((!calibration.converged && !calibration.limited).then(not_converged));
        let report = report(loaded, calibration, findings);
        let options = WriteOptions { original: Some(&loaded.text), ..Default::default() };
        let model_toml = calibration.model.to_toml(&options);
        let json =
            serde_json::to_value(&report).map_err(|e| Failure::internal(format!("report.json: {e}")))?;
        let recordings = calibrated_recordings(calibration);
        Ok(Results {
            report_json: format!("{json:#}\n"),
            model_toml,
            story: in_words(&report),
            json,
            recordings,
        })
    }

    /// The files, by name.
    pub fn files(&self) -> [(&'static str, &[u8]); 2] {
        let [model, json] = FILES;
        [(model, self.model_toml.as_bytes()), (json, self.report_json.as_bytes())]
    }
}

/// Sees that a parameter may move.
///
/// # Errors
/// Bad input where every parameter is fixed.
pub fn has_free_parameter(loaded: &LoadedModel) -> Result<(), Failure> {
    if loaded.model.parameters.iter().all(|p| p.fixed) {
        return Err(Failure::file(
            &loaded.path,
            "every parameter is fixed, so there is nothing to calibrate",
        )
        .help("take `fixed = true` from the parameters that may move"));
    }
    Ok(())
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

fn report(loaded: &LoadedModel, calibration: &Calibration, findings: Vec<contract::Finding>) -> Report {
    let data = &calibration.data;
    let fit_set = |(nominal, calibrated): &(Vec<Score>, Vec<Score>)| FitSet {
        nominal: scores(data, nominal),
        calibrated: scores(data, calibrated),
        improved: Ordered::new(),
    };
    let floor = data.sigma.iter().zip(&data.spread).map(|(sigma, spread)| sigma / spread);
    Report {
        greybox: Producer::this(0),
        model: ModelId { name: loaded.model.name.clone(), file: loaded.file.clone() },
        parameters: parameters(&loaded.model, &calibration.parameters),
        fit: contract::Fit {
            train: fit_set(&calibration.train),
            holdout: fit_set(&calibration.holdout),
            window_s: Some(calibration.window),
            criterion: greybox_report::convert::criterion(calibration.criterion),
            holdout_source: held_out(calibration.holdout_source, &calibration.held.recordings),
            recordings: Ordered::new(),
        },
        noise_floor: data.channels.iter().map(|c| c.name.clone()).zip(floor).collect(),
        findings,
    }
}

/// Inputs whose noise is a good part of what the calibrated model leaves, if they are measurements.
fn input_noise(calibration: &Calibration) -> Vec<contract::Finding> {
    let Ok(setup) = Setup::new(&calibration.model, calibration.data.clone(), Vec::new()) else {
        return Vec::new();
    };
    let found = input_noise::findings(&setup, &setup.values(), &calibration.train_runs.1, true);
    let mut found: Vec<_> = found.into_iter().map(|f| health_finding(f, None)).collect();
    found.retain(|f| f.severity > contract::Severity::Info);
    found
}

/// The fits ended before their end.
fn limit() -> contract::Finding {
    contract::Finding {
        severity: contract::Severity::Warning,
        code: "limit".to_owned(),
        recording: None,
        channel: None,
        message: "the fits ended at their limit of work: the parameters may not be the best ones".to_owned(),
        help: Some(
            "give it a shorter recording, or fix parameters that the recordings do not show".to_owned(),
        ),
    }
}

/// The last fit was still gaining.
fn not_converged() -> contract::Finding {
    contract::Finding {
        severity: contract::Severity::Warning,
        code: "not_converged".to_owned(),
        recording: None,
        channel: None,
        message: "the fit has not converged: it was still gaining when its steps were used up, and the parameters may \
                  not be the best ones"
            .to_owned(),
        help: Some("calibrate the model that was written once more, or fix parameters that the recordings do not show".to_owned()),
    }
}

/// The parameters before and after, in the units of the model file.
fn parameters(model: &Model, changes: &[ParameterChange]) -> Ordered<Parameter> {
    changes
        .iter()
        .filter_map(|change| {
            let p = model.parameters.get(change.index)?;
            let reported = |si: f64| p.unit.as_ref().map_or(si, |u| u.from_si(si));
            let parameter = Parameter {
                nominal: reported(change.nominal),
                value: reported(change.calibrated.value),
                ci95: change.calibrated.ci95.map(|(low, high)| Interval::new(reported(low), reported(high))),
                unit: p.unit.as_ref().map(|u| u.text.clone()),
                fixed: p.fixed,
                calibrated: None,
                calibrated_ci95: None,
            };
            Some((p.name.clone(), parameter))
        })
        .collect()
}

fn in_words(report: &Report) -> String {
    format!(
        "{}{}{}",
        story::parameter_table(&report.parameters),
        story::fit_table(&report.fit, &report.noise_floor),
        story::notes(&report.findings),
    )
}
