//! What speaks for laws without a name, and how far: where the recordings know them, how they predict what was left out of
//! their fit, and which parameter of the machine could do their work.

use greybox_calibrate::{Criterion, Data};
use greybox_model::Expr;

use crate::along::Along;
use crate::library::Mechanism;
use crate::search::{Fitted, Part};
use crate::uncertainty::Uncertainty;
use crate::validate;

/// What speaks for the laws that an improved model holds without a name.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// The variables of their forces.
    pub ranges: Vec<Range>,
    /// Share of the held-out samples where one of the variables is beyond its range; NaN where nothing can be said.
    pub outside: f64,
    /// Cross-validation, fold by fold.
    pub folds: Vec<Fold>,
    /// By strength or constant of a law: what it trades with.
    pub trades: Vec<(String, Trade)>,
}

/// Where a variable was in the training recordings, as the improved model simulates them.
#[derive(Debug, Clone, PartialEq)]
pub struct Range {
    /// Expression of the model.
    pub variable: String,
    /// Least and largest value, SI.
    pub low: f64,
    /// See `low`.
    pub high: f64,
    /// Share of the held-out samples beyond them.
    pub outside: f64,
}

/// What was left out of a fit, and how it was predicted.
#[derive(Debug, Clone, PartialEq)]
pub struct Fold {
    /// The recordings.
    pub recordings: Vec<String>,
    /// From when to when, s from the start, of a part of one recording.
    pub window: Option<(f64, f64)>,
    /// RMS error over the RMS of the measurement about its mean, geometric mean over the channels, of the calibrated model
    /// fitted without the fold; infinite where it diverges.
    pub calibrated: f64,
    /// Of the improved one.
    pub improved: f64,
}

/// The parameter of the machine whose estimate goes most with that of a law.
#[derive(Debug, Clone, PartialEq)]
pub struct Trade {
    /// Its name.
    pub parameter: String,
    /// Correlation of the estimates, −1 to 1.
    pub correlation: f64,
}

/// A fitted model that takes part in a cross-validation, and the size of its residual.
pub(crate) type Sized<'a> = (&'a Fitted, &'a [f64]);

impl Proposal {
    /// Of the parts of `improved` that `is_proposed` picks, fitted with `uncertainty`, whose states are those of `train` and
    /// `held`; `calibrated` and `origin` are the models as they were fitted.
    pub(crate) fn of(
        improved: &Fitted,
        library: &[Mechanism],
        is_proposed: impl Fn(usize) -> bool,
        (train, held): (&Along<'_>, &Along<'_>),
        (calibrated, origin): (Sized<'_>, Sized<'_>),
        (criterion, window): (Criterion, f64),
        uncertainty: &Uncertainty,
    ) -> Proposal {
        let parts: Vec<&Part> = improved
            .parts
            .iter()
            .enumerate()
            .filter(|(i, _)| is_proposed(*i))
            .map(|(_, part)| part)
            .collect();
        let mut variables: Vec<Expr> = Vec::new();
        for part in &parts {
            for variable in variables_of(improved, part, library) {
                if !variables.contains(&variable) {
                    variables.push(variable);
                }
            }
        }
        let (ranges, outside) = ranges(&variables, train, held);
        let errors = |(fitted, scale): Sized<'_>| validate::errors(fitted, scale, criterion, window);
        let data = &origin.0.setup.data;
        let both = errors(calibrated).into_iter().zip(errors(origin));
        let folds = validate::folds(data).into_iter().zip(both);
        let folds = folds.map(|(left_out, errors)| Fold::of(data, &left_out, errors));
        Proposal { ranges, outside, folds: folds.collect(), trades: trades(improved, &parts, uncertainty) }
    }
}

impl Fold {
    /// With the logarithms of the errors of the calibrated and the improved model.
    fn of(data: &Data, left_out: &validate::Fold, (calibrated, improved): (f64, f64)) -> Fold {
        let mut recordings: Vec<String> = Vec::new();
        for (piece, _) in left_out {
            let name = &data.recordings[data.pieces[*piece].recording];
            if !recordings.contains(name) {
                recordings.push(name.clone());
            }
        }
        let ends = left_out.iter().map(|(piece, range)| {
            let piece = &data.pieces[*piece];
            let at = |k: usize| piece.start + k as f64 * piece.dt;
            (at(range.start), at(range.end.saturating_sub(1)))
        });
        let window = ends.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        Fold {
            recordings,
            window: window.filter(|_| data.recordings.len() == 1),
            calibrated: calibrated.exp(),
            improved: improved.exp(),
        }
    }
}

/// The variables that the force of a part depends on: positions and rates.
fn variables_of(improved: &Fitted, part: &Part, library: &[Mechanism]) -> Vec<Expr> {
    let mechanism = &library[part.candidate.mechanism];
    let model = &improved.setup.model;
    let of = |name: &str, primes: u8| {
        if !mechanism.depends_on(name, primes) {
            return None;
        }
        let expression =
            part.candidate.translate(model, &Expr::prime(name, primes), &str::to_string).simplify();
        // (A law seen from the other side.)
        Some(if let Expr::Neg(inner) = expression { *inner } else { expression })
    };
    ["d", "o"].into_iter().flat_map(|name| [of(name, 0), of(name, 1)]).flatten().collect()
}

/// Ranges of the variables, and the share of the held-out samples where one of them is beyond its own.
fn ranges(variables: &[Expr], train: &Along<'_>, held: &Along<'_>) -> (Vec<Range>, f64) {
    let mut ranges = Vec::new();
    let mut beyond: Vec<bool> = Vec::new();
    for variable in variables {
        let one = std::slice::from_ref(variable);
        let values = |along: &Along<'_>| -> Option<Vec<f64>> { Some(along.eval(one, &[])?.pop()?.concat()) };
        let (Some(train), Some(held)) = (values(train), values(held)) else { continue };
        let known = train.into_iter().filter(|v| v.is_finite());
        let (low, high) =
            known.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (v.min(low), v.max(high)));
        beyond.resize(held.len(), false);
        let is_beyond: Vec<bool> = held.iter().map(|v| !(low..=high).contains(v)).collect();
        beyond.iter_mut().zip(&is_beyond).for_each(|(any, own)| *any |= own);
        ranges.push(Range { variable: variable.to_string(), low, high, outside: share(&is_beyond) });
    }
    (ranges, share(&beyond))
}

fn share(of: &[bool]) -> f64 {
    of.iter().filter(|is| **is).count() as f64 / of.len() as f64
}

/// For each parameter of the parts the parameter of the machine that its estimate goes with most.
fn trades(improved: &Fitted, parts: &[&Part], uncertainty: &Uncertainty) -> Vec<(String, Trade)> {
    let setup = &improved.setup;
    let position = |name: &String| {
        let index = setup.model.parameter(name)?;
        setup.free.iter().position(|f| f.index == index)
    };
    let laws: Vec<&String> = improved.parts.iter().flat_map(|part| &part.instance.names).collect();
    let name = |free: usize| &setup.model.parameters[setup.free[free].index].name;
    let own: Vec<usize> = (0..setup.free.len()).filter(|&i| !laws.contains(&name(i))).collect();
    let of = |law: &String| {
        let at = position(law)?;
        let with = own.iter().map(|&i| (i, uncertainty.correlation(at, i))).filter(|(_, r)| r.is_finite());
        let (most, correlation) = with.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
        Some((law.clone(), Trade { parameter: name(most).clone(), correlation }))
    };
    parts.iter().flat_map(|part| &part.instance.names).filter_map(of).collect()
}
