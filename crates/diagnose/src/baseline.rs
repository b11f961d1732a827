//! The baseline: the nominal equations with the parameters that simulate the training recordings best, and how simulations are
//! judged.

use std::cell::OnceCell;
use std::sync::Arc;

use greybox_calibrate::{
    Criterion, Ending, Fit, Horizon, Limits, Point, Score, Segmentation, Setup, Work, window_length,
    window_of,
};
use rayon::prelude::*;

use crate::ProgressListener;
use crate::fitted::{FittedModel, Found, rms};
use crate::search::{MISFIT, Search};

/// Limits of the fit at each horizon.
const HORIZON: Limits = Limits { iterations: 30, tolerance: 1e-6 };
/// Limits of the best of these fits, where it has not ended.
const FURTHER: Limits = Limits { iterations: 100, tolerance: 1e-6 };

/// RMS of the residual by channel, at least 0.7 of the noise; of a whitened residual the scale of the innovations.
pub(crate) fn residual_scale(fitted: &FittedModel, scale: &[f64]) -> Vec<f64> {
    if fitted.setup.noise.is_some() {
        return scale.to_vec(); // that of the innovations
    }
    rms(&fitted.fit, scale).iter().zip(&fitted.setup.data.sigma).map(|(r, s)| r.max(0.7 * s)).collect()
}

/// Hears of the work, which it may give up, and of nothing else.
pub(crate) struct WorkOnlyListener<'a>(pub(crate) &'a dyn ProgressListener);

impl ProgressListener for WorkOnlyListener<'_> {
    fn begins(&self, work: &Arc<Work>) {
        self.0.begins(work);
    }
}

/// A search that changes parameters, and the holds of inputs if it may, and nothing else.
pub(crate) fn alone(
    nominal: &Setup,
    keep_holds: bool,
    most_work: u64,
    listener: &dyn ProgressListener,
) -> Found {
    // With a limit of work of its own.
    let alone = Setup { work: Arc::new(Work::of_fits_within(most_work)), ..nominal.clone() };
    listener.begins(&alone.work);
    let mut search = Search::new(alone, &[], listener);
    search.keep_holds = keep_holds;
    search.most_work = most_work;
    let found = search.run();
    listener.begins(&nominal.work);
    found
}

/// A fit in segments, at parameters that a fit of whole pieces may have found.
#[derive(Debug, Clone)]
pub(crate) struct WholeRecordFit {
    pub(crate) fitted: FittedModel,
    /// The fit that found the parameters. Their intervals are taken here: the free starts of segments know less of
    /// the parameters than whole pieces do.
    pub(crate) origin: FittedModel,
}

impl WholeRecordFit {
    pub(crate) fn kept(fitted: FittedModel) -> WholeRecordFit {
        WholeRecordFit { origin: fitted.clone(), fitted }
    }

    /// `fitted` at the parameters of `whole`, its segments' starts refitted.
    pub(crate) fn at(fitted: &FittedModel, level: Segmentation, whole: Fit, scale: &[f64]) -> WholeRecordFit {
        let free = Setup { free: Vec::new(), ..fitted.setup.clone() };
        let point =
            Point { parameters: whole.point.parameters.clone(), starts: fitted.fit.point.starts.clone() };
        let fit = free.fit(&fitted.level, scale, &[point], Limits { iterations: 8, tolerance: 1e-6 });
        let origin = FittedModel { level, fit: whole, ..fitted.clone() };
        WholeRecordFit { fitted: FittedModel { fit, ..fitted.clone() }, origin }
    }
}

/// The equations as they are, with the parameters that simulate the training recordings best in free run.
pub(crate) struct Baseline {
    pub(crate) polished: WholeRecordFit,
    /// Its residual.
    pub(crate) scale: Vec<f64>,
    /// How its simulations are judged ([`Criterion::misfit`]).
    pub(crate) misfit: f64,
    /// Its errors on folds, once somebody asks.
    pub(crate) errors: OnceCell<Vec<f64>>,
}

impl Baseline {
    /// Its errors on what is left out of its fit.
    pub(crate) fn errors(&self, judge: &Judge) -> &[f64] {
        self.errors.get_or_init(|| judge.errors(&self.polished, &self.scale))
    }

    /// What a search found without mechanisms, refitted at growing horizons, from its parameters and from the nominal
    /// ones: of all these fits the one that the criterion judges best.
    pub(crate) fn of(found: &Found, nominal: &[f64], judge: &Judge) -> Baseline {
        let (fitted, setup) = (&found.calibrated, &found.calibrated.setup);
        let own = residual_scale(fitted, &found.scale);
        let measured = Point { parameters: nominal.to_vec(), starts: setup.starts(&fitted.level, nominal) };
        let points = [fitted.fit.point.clone(), measured];
        let mut polished = best_horizon(fitted, &points, &own, &found.scale, judge, &|_| true);
        // A fit to segments may simulate the whole worse than what it began with.
        if judge.misfit(setup, nominal, &own)
            < judge.misfit(setup, &polished.fitted.fit.point.parameters, &own)
        {
            let level = setup.level(1);
            let as_given = Point { parameters: nominal.to_vec(), starts: setup.starts(&level, nominal) };
            let held = Limits { iterations: 0, ..HORIZON };
            let fit = setup.fit(&level, &own, &[as_given], held);
            polished = WholeRecordFit::at(fitted, level, fit, &found.scale);
        }
        let scale = residual_scale(&polished.fitted, &found.scale);
        let misfit = judge.misfit(setup, &polished.fitted.fit.point.parameters, &scale);
        Baseline { polished, scale, misfit, errors: OnceCell::new() }
    }
}

/// How simulations of the training recordings are judged.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Judge {
    pub(crate) criterion: Criterion,
    /// Window of restarted simulations, s.
    pub(crate) window: f64,
}

impl Judge {
    /// By what a fitted model says of the machine.
    pub(crate) fn of(fitted: &FittedModel, scale: &[f64]) -> Judge {
        let setup = &fitted.setup;
        let durations: Vec<f64> =
            setup.data.pieces.iter().map(|p| p.len.saturating_sub(1) as f64 * p.dt).collect();
        let dt = setup.data.pieces.iter().map(|p| p.dt).fold(0.0, f64::max);
        let window = window_length(&durations, dt);
        let (criterion, predictable) = setup.criterion(&fitted.fit.point.parameters, scale);
        Judge { criterion, window: if predictable < window { window_of(predictable, dt) } else { window } }
    }

    /// Errors on what is left out of the fit, fold by fold.
    pub(crate) fn errors(&self, polished: &WholeRecordFit, scale: &[f64]) -> Vec<f64> {
        crate::validate::errors(&polished.origin, scale, self.criterion, self.window)
    }

    pub(crate) fn misfit(&self, setup: &Setup, parameters: &[f64], scale: &[f64]) -> f64 {
        self.criterion.misfit(&self.scores(setup, parameters, scale))
    }

    pub(crate) fn scores(&self, setup: &Setup, parameters: &[f64], scale: &[f64]) -> Vec<Score> {
        let run = setup.training_run(parameters, scale);
        let window = match self.criterion {
            Criterion::FreeRun => f64::INFINITY,
            Criterion::Windowed => self.window,
        };
        setup.scores(&run, parameters, window, None)
    }
}

/// Whether free runs leave no more than noise: in each channel at most [`MISFIT`] of its white noise, or a residual that passes
/// for coloured noise.
pub(crate) fn leaves_noise(scores: &[Score], fitted: &FittedModel, scale: &[f64]) -> bool {
    let coloured = crate::search::coloured_channels(fitted, scale);
    let over = scores.iter().zip(&fitted.setup.data.sigma).map(|(s, sigma)| s.rmse / sigma);
    over.zip(coloured).all(|(over, coloured)| coloured || over <= MISFIT)
}

/// A model refitted at growing horizons from each of these points of its level: of all fits, and the model as it is, the
/// one that is judged best among those that are allowed.
fn best_horizon(
    fitted: &FittedModel,
    points: &[Point],
    own: &[f64],
    scale: &[f64],
    judge: &Judge,
    is_allowed: &(dyn Fn(&Point) -> bool + Sync),
) -> WholeRecordFit {
    let setup = &fitted.setup;
    let misfit = |point: &Point| judge.misfit(setup, &point.parameters, own);
    let grown = |point: &Point| -> Vec<(f64, Horizon)> {
        let horizons = setup.grow(&fitted.level, point, own, HORIZON);
        horizons.into_par_iter().map(|horizon| (misfit(&horizon.fit.point), horizon)).collect()
    };
    let (as_it_is, grown): (f64, Vec<Vec<(f64, Horizon)>>) =
        rayon::join(|| misfit(&fitted.fit.point), || points.par_iter().map(grown).collect());
    let mut best = (as_it_is, None);
    for (quality, horizon) in grown.into_iter().flatten() {
        if quality < best.0 && is_allowed(&horizon.fit.point) {
            best = (quality, Some(horizon));
        }
    }
    match best.1 {
        Some(Horizon { level, mut fit }) => {
            if fit.ending == Ending::Limit {
                let further = setup.fit(&level, own, std::slice::from_ref(&fit.point), FURTHER);
                if misfit(&further.point) <= best.0 && is_allowed(&further.point) {
                    fit = further;
                }
            }
            WholeRecordFit::at(fitted, level, fit, scale)
        }
        None => WholeRecordFit::kept(fitted.clone()),
    }
}

/// The improved model refitted at growing horizons, its laws as they are required to be.
pub(crate) fn polish(
    search: &Search<'_>,
    fitted: &FittedModel,
    scale: &[f64],
    judge: &Judge,
) -> WholeRecordFit {
    let own = residual_scale(fitted, scale);
    let is_allowed =
        |point: &Point| fitted.parts.iter().all(|p| search.allows(p, &fitted.setup, &point.parameters));
    best_horizon(fitted, std::slice::from_ref(&fitted.fit.point), &own, scale, judge, &is_allowed)
}
