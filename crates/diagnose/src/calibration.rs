//! Calibration alone: the same equations, the parameters refitted.

use std::sync::Arc;

use greybox_calibrate::{Criterion, Data, Ending, FreeRun, HoldoutSource, Score, Setup, free_parameters};
use greybox_model::Model;
use greybox_recording::Recording;

use crate::ProgressListener;
use crate::baseline::{Baseline, Judge, WholeRecordFit, alone, residual_scale};
use crate::diagnosis::{DiagnoseError, Estimate, ParameterChange};
use crate::layout::{Layout, follows, layout};
use crate::search::MOST_WORK;
use crate::uncertainty::Uncertainty;

/// Calibrates only: the same equations, parameters refitted.
#[derive(Debug)]
pub struct Calibration {
    /// The model with the fitted parameters.
    pub model: Model,
    /// Nominal and calibrated value with interval per parameter.
    pub parameters: Vec<ParameterChange>,
    /// Scores on the training recordings: nominal, calibrated.
    pub train: (Vec<Score>, Vec<Score>),
    /// Scores on the held-out recordings.
    pub holdout: (Vec<Score>, Vec<Score>),
    /// Where the held-out data come from.
    pub holdout_source: HoldoutSource,
    /// Window of the restarted simulations, s.
    pub window: f64,
    /// The data.
    pub data: Arc<Data>,
    /// Held-out data.
    pub held: Arc<Data>,
    /// By which figure simulations were judged.
    pub criterion: Criterion,
    /// The last fit ended because nothing more was to be gained.
    pub converged: bool,
    /// The fits ended at their limit of work, not because nothing more was to be gained.
    pub limited: bool,
    /// Free runs on the training recordings: nominal, calibrated.
    pub train_runs: (FreeRun, FreeRun),
    /// Free runs on the held-out recordings.
    pub holdout_runs: (FreeRun, FreeRun),
}

/// Scores and free runs of two models.
type Both = ((Vec<Score>, Vec<Score>), (FreeRun, FreeRun));

/// Refits the parameters of a model, with uncertainties.
///
/// # Errors
/// As [`diagnose`](crate::diagnose).
pub fn calibrate(
    model: &Model,
    train: &[Recording],
    holdout: &[Recording],
    listener: &dyn ProgressListener,
) -> Result<Calibration, DiagnoseError> {
    let Layout { train, holdout, source } = layout(model, train, holdout)?;
    let nominal = Setup::new(model, train.clone(), free_parameters(model))?.with_strides();
    let found = alone(&nominal, true, MOST_WORK, listener);
    let judge = Judge::of(&found.calibrated, &residual_scale(&found.calibrated, &found.scale));
    let window = judge.window;
    let Baseline { polished: WholeRecordFit { fitted, origin }, scale, .. } =
        Baseline::of(&found, &nominal.values(), &judge);
    let widths = Uncertainty::of(&origin, &scale).widths();
    let values = &fitted.fit.point.parameters;
    let mut calibrated = model.clone();
    for (p, v) in calibrated.parameters.iter_mut().zip(values) {
        p.value = *v;
    }
    let parameters = (0..model.parameters.len())
        .map(|i| {
            let width = fitted.setup.free.iter().position(|f| f.index == i).map(|k| widths[k]);
            let e = Estimate { value: values[i], ci95: width.map(|w| (values[i] - w, values[i] + w)) };
            ParameterChange { index: i, nominal: model.parameters[i].value, calibrated: e, improved: e }
        })
        .collect();
    let spread: Vec<f64> = train.spread.iter().map(|s| s.max(1e-300)).collect();
    let runs = |data: &Arc<Data>, held: bool| -> Both {
        let fine: Vec<f64> = scale.iter().map(|s| 0.02 * s).collect();
        let setup = fitted.setup.for_simulations_of(data.clone(), values, &fine);
        let run = |parameters: &[f64], scale: &[f64]| match held {
            true => setup.free_run(parameters, scale),
            false => setup.training_run(parameters, scale),
        };
        let before = run(&nominal.values(), &spread);
        let after = run(values, &scale);
        let scores = (
            setup.scores(&before, &nominal.values(), window, None),
            setup.scores(&after, values, window, None),
        );
        (scores, (before, after))
    };
    let (train_scores, train_runs) = runs(&train, false);
    follows([&train_runs.1], &train)?;
    let (holdout_scores, holdout_runs) = runs(&holdout, true);
    Ok(Calibration {
        model: calibrated,
        parameters,
        train: train_scores,
        holdout: holdout_scores,
        holdout_source: source,
        window,
        data: train,
        held: holdout,
        criterion: judge.criterion,
        converged: origin.fit.ending != Ending::Limit,
        limited: found.limited,
        train_runs,
        holdout_runs,
    })
}
