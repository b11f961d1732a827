//! What many machines say of one parameter: its mean, how much machines differ, what each has of its own, what it
//! depends on, and which machines are unlike the others.
//!
//! Recording i of machine m(i) gives an estimate with a standard error, and has covariates (a temperature, a date). The
//! mixed model of [`analyse`] has two coefficients for each covariate, where the recordings tell them apart: *within*
//! machines, of how far it is from the machine's own mean, and *between* machines, of the machine's mean (Y. Mundlak,
//! "On the pooling of time series and cross section data", Econometrica 46(1), 1978, 69–85,
//! <https://doi.org/10.2307/1913646>). A machine that ages shows in the first; a batch of old machines in the second.

use std::collections::BTreeMap;

use nalgebra::DVector;
use statrs::distribution::{ContinuousCDF, StudentsT};

use crate::mixed::{Fit, Predicted, Problem};
use crate::pool::{Effect, pool};

/// A probability below this is taken for no chance; of several questions, each gets its share of it (Bonferroni).
pub const SIGNIFICANT: f64 = 0.05;

/// Fewest machines of which a scatter between machines is estimated.
pub const FEWEST: usize = 3;

/// Most machines that can be found to differ: a tenth of all, and no more than a list that one reads.
pub const MOST_DIFFERENT: usize = 30;

/// A covariate that is a combination of others leaves no more than this of its sum of squares.
const INDEPENDENT: f64 = 1e-6;

/// The estimate of one recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// Which machine was recorded.
    pub machine: usize,
    /// Estimate and standard error.
    pub effect: Effect,
    /// Value of each covariate; NaN, or none at the end of the list, where it is not known.
    pub covariates: Vec<f64>,
}

/// A number with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// Best estimate.
    pub value: f64,
    /// Half the width of its 95 % interval.
    pub half_width: f64,
}

impl Interval {
    /// Both ends.
    pub fn ends(&self) -> [f64; 2] {
        [self.value - self.half_width, self.value + self.half_width]
    }
}

/// Whether a machine changes with a covariate, or machines differ by it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// From recording to recording of one machine.
    Within,
    /// From machine to machine.
    Between,
}

/// How the parameter depends on a covariate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slope {
    /// Which covariate.
    pub covariate: usize,
    /// Within machines or between them.
    pub level: Level,
    /// Change of the parameter per unit of the covariate.
    pub slope: Interval,
    /// Probability of so steep a slope where there is none.
    pub p_value: f64,
    /// Whether it is taken for real: its probability is below [`SIGNIFICANT`] over the number of slopes.
    pub significant: bool,
}

/// What one machine has of its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Machine {
    /// Which machine.
    pub machine: usize,
    /// How many of its recordings give an estimate.
    pub recordings: usize,
    /// Its value: drawn towards the others by what they say of it, unless it differs from them.
    pub value: Interval,
    /// Whether it is unlike the others: the probability of so large a difference, where it is one of them.
    pub differs: Option<f64>,
}

/// One parameter over the machines.
#[derive(Debug, Clone, PartialEq)]
pub struct Machines {
    /// Mean over the machines that do not differ, at the mean of the covariates.
    pub mean: Interval,
    /// τ_b, the standard deviation from machine to machine.
    pub between: f64,
    /// τ_w, the standard deviation from recording to recording of one machine; `None` where every machine has one recording.
    pub within: Option<f64>,
    /// What it depends on.
    pub slopes: Vec<Slope>,
    /// Every machine with an estimate, in the order of their numbers.
    pub machines: Vec<Machine>,
}

/// A column of regressors.
#[derive(Debug, Clone)]
struct Column {
    covariate: usize,
    level: Level,
    /// Its values were divided by this.
    scale: f64,
    values: Vec<f64>,
}

/// The mixed model of one parameter; `None` where fewer than [`FEWEST`] machines give an estimate.
///
/// A covariate that most recordings lack is left out; then recordings that lack one of the others are. A covariate enters
/// where it varies and leaves degrees of freedom.
///
/// Machines that differ are found by a generalised extreme studentised deviate test: the machine farthest from what the
/// others say of it is taken out, again and again, up to a tenth of the machines; all that were taken out up to the last
/// one whose deviation has a probability below [`SIGNIFICANT`] over the number of machines differ (B. Rosner,
/// "Percentage points for a generalized ESD many-outlier procedure", Technometrics 25(2), 1983, 165–172,
/// <https://doi.org/10.1080/00401706.1983.10487848>).
///
/// ```
/// use greybox_fleet::machines::{Estimate, analyse};
/// use greybox_fleet::pool::Effect;
///
/// // Eleven machines around 1.0 and one at 2.0, two recordings each, known to 0.02.
/// let estimates: Vec<Estimate> = (0..24)
///     .map(|k| {
///         let machine = k / 2;
///         let own = if machine == 7 { 2.0 } else { 1.0 + 0.05 * (machine as f64).sin() };
///         let value = own + 0.02 * (k as f64 * 2.3).cos();
///         Estimate { machine, effect: Effect { value, error: 0.02 }, covariates: vec![] }
///     })
///     .collect();
/// let found = analyse(&estimates).unwrap();
/// let different: Vec<usize> =
///     found.machines.iter().filter(|m| m.differs.is_some()).map(|m| m.machine).collect();
/// assert_eq!(different, [7]);
/// assert!((found.mean.value - 1.0).abs() < 0.05 && found.between < 0.1);
/// ```
pub fn analyse(estimates: &[Estimate]) -> Option<Machines> {
    let scale = typical_error(estimates)?;
    let (used, known) = complete(estimates);
    let columns = columns(&used, &known);
    let rows = used.iter().enumerate().map(|(i, Estimate { machine, effect, .. })| {
        let row = std::iter::once(1.0).chain(columns.iter().map(|column| column.values[i]));
        let row = DVector::from_iterator(1 + columns.len(), row);
        (*machine, effect.value / scale, (effect.error / scale).powi(2), row)
    });
    let (problem, numbers) = Problem::new(rows);
    if problem.machines() < FEWEST {
        return None;
    }
    let effects: Vec<Effect> = used.iter().map(|estimate| estimate.effect).collect();
    let start = pool(&effects)?.heterogeneity.map_or(0.0, |h| h.between) / (scale * scale);
    let repeated = used.len() > problem.machines();
    let free = [true, repeated];
    let at_machines = 1 + columns.iter().filter(|column| column.level == Level::Between).count();
    let first = problem.fit([0.5 * start, 0.5 * start], free)?;
    let (different, fit, remaining) = different(&problem, first, free, at_machines);

    let machine_freedom = freedom(remaining, at_machines)?;
    let within = columns.len() + 1 - at_machines;
    let recording_freedom = freedom(used.len().saturating_sub(problem.machines()), within);
    let interval = |estimate: Predicted, freedom: StudentsT| Interval {
        value: scale * estimate.value,
        half_width: scale * estimate.error * freedom.inverse_cdf(0.975),
    };
    let coefficient = |k: usize| Predicted { value: fit.beta[k], error: fit.covariance[(k, k)].sqrt() };
    let slopes = columns.iter().enumerate().filter_map(|(k, column)| {
        let estimate = coefficient(k + 1);
        let freedom = if column.level == Level::Between { machine_freedom } else { recording_freedom? };
        let p_value = 2.0 * freedom.sf((estimate.value / estimate.error).abs());
        let per_unit =
            Predicted { value: estimate.value / column.scale, error: estimate.error / column.scale };
        Some(Slope {
            covariate: column.covariate,
            level: column.level,
            slope: interval(per_unit, freedom),
            p_value,
            significant: p_value * (columns.len() as f64) < SIGNIFICANT,
        })
    });
    let mut machines: Vec<Machine> = (0..problem.machines())
        .map(|m| {
            let differs = different.iter().find(|(number, _)| *number == m).map(|(_, p)| *p);
            let estimate = if differs.is_some() { problem.alone(m, &fit) } else { problem.shrunken(m, &fit) };
            Machine {
                machine: numbers[m],
                recordings: problem.recordings(m),
                value: interval(estimate, machine_freedom),
                differs,
            }
        })
        .collect();
    machines.sort_by_key(|machine| machine.machine);
    Some(Machines {
        mean: interval(coefficient(0), machine_freedom),
        between: scale * fit.variances[0].sqrt(),
        within: repeated.then(|| scale * fit.variances[1].sqrt()),
        slopes: slopes.collect(),
        machines,
    })
}

/// The median standard error: the unit in which everything is computed.
fn typical_error(estimates: &[Estimate]) -> Option<f64> {
    let mut errors: Vec<f64> = estimates.iter().map(|estimate| estimate.effect.error).collect();
    errors.sort_by(f64::total_cmp);
    errors.get(errors.len() / 2).copied().filter(|error| *error > 0.0)
}

/// Student's t with the degrees of freedom that are left; `None` where there are none.
fn freedom(count: usize, used: usize) -> Option<StudentsT> {
    let left = count.checked_sub(used).filter(|left| *left > 0)?;
    StudentsT::new(0.0, 1.0, left as f64).ok()
}

/// The machines that differ, each with its probability; the fit of the others, and how many those are.
fn different(problem: &Problem, first: Fit, free: [bool; 2], used: usize) -> (Vec<(usize, f64)>, Fit, usize) {
    let count = problem.machines();
    let most = count.div_ceil(10).min(MOST_DIFFERENT);
    let mut rest = problem.clone();
    // Numbers of the remaining machines in `problem`.
    let mut numbers: Vec<usize> = (0..count).collect();
    let mut fit = first.clone();
    let mut taken: Vec<(usize, f64)> = Vec::new();
    let (mut last, mut fits) = (0, vec![first]);
    for _ in 0..most {
        let farthest = (0..rest.machines())
            .filter_map(|m| Some((m, rest.deleted(m, &fit)?.abs())))
            .max_by(|(_, a), (_, b)| a.total_cmp(b));
        let Some((machine, _)) = farthest else { break };
        let smaller = rest.without(machine);
        let (Some(next), Some(t)) = (smaller.fit(fit.variances, free), freedom(smaller.machines(), used))
        else {
            break;
        };
        let p = 2.0 * t.sf(rest.deviation(machine, &next).abs());
        taken.push((numbers.remove(machine), p));
        if p * (rest.machines() as f64) < SIGNIFICANT {
            last = taken.len();
        }
        (rest, fit) = (smaller, next);
        fits.push(fit.clone());
    }
    taken.truncate(last);
    (taken, fits.swap_remove(last), count - last)
}

/// The estimates whose covariates are all known, and which covariates those are: what most recordings lack does not count.
fn complete(estimates: &[Estimate]) -> (Vec<&Estimate>, Vec<usize>) {
    let count = estimates.iter().map(|estimate| estimate.covariates.len()).max().unwrap_or(0);
    let has = |estimate: &&Estimate, covariate: usize| {
        estimate.covariates.get(covariate).is_some_and(|value| value.is_finite())
    };
    let known: Vec<usize> = (0..count)
        .filter(|&covariate| 2 * estimates.iter().filter(|e| has(e, covariate)).count() > estimates.len())
        .collect();
    let complete = estimates.iter().filter(|e| known.iter().all(|&covariate| has(e, covariate))).collect();
    (complete, known)
}

/// The regressors: for each known covariate within and between machines, where it varies, is no combination of those before
/// it, and leaves degrees of freedom.
fn columns(estimates: &[&Estimate], known: &[usize]) -> Vec<Column> {
    let mut chosen: Vec<Column> = Vec::new();
    for &covariate in known {
        let given: Vec<f64> = estimates.iter().map(|e| e.covariates[covariate]).collect();
        let means = machine_means(estimates, &given);
        let machines = means.len();
        let overall = means.values().sum::<f64>() / machines as f64;
        let mean_of = |i: usize| means.get(&estimates[i].machine).copied().unwrap_or(overall);
        let within = given.iter().enumerate().map(|(i, v)| v - mean_of(i)).collect();
        let between = (0..given.len()).map(|i| mean_of(i) - overall).collect();
        for (level, values, room) in [
            (Level::Within, within, given.len() - machines),
            (Level::Between, between, machines.saturating_sub(1)),
        ] {
            let used = chosen.iter().filter(|column| column.level == level).count();
            // One degree of freedom at least is left for the scatter.
            if room < used + 2 {
                continue;
            }
            chosen.extend(scaled(covariate, level, values, overall, &chosen));
        }
    }
    chosen
}

/// The mean of a covariate over the recordings of each machine.
fn machine_means(estimates: &[&Estimate], values: &[f64]) -> BTreeMap<usize, f64> {
    let mut sums: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
    for (estimate, value) in estimates.iter().zip(values) {
        let (sum, count) = sums.entry(estimate.machine).or_default();
        *sum += value;
        *count += 1;
    }
    sums.into_iter().map(|(machine, (sum, count))| (machine, sum / count as f64)).collect()
}

/// A column in units of its own root mean square; `None` where it does not vary or follows from the others.
fn scaled(
    covariate: usize,
    level: Level,
    mut values: Vec<f64>,
    around: f64,
    others: &[Column],
) -> Option<Column> {
    let squares = |values: &[f64]| values.iter().map(|v| v * v).sum::<f64>();
    let scale = (squares(&values) / values.len() as f64).sqrt();
    // What rounding leaves of a constant is no variation.
    if scale.is_nan() || scale <= 1e-12 * around.abs() {
        return None;
    }
    values.iter_mut().for_each(|v| *v /= scale);
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for other in others {
        let mut direction = other.values.clone();
        basis.iter().for_each(|b| take_out(&mut direction, b));
        basis.push(direction);
    }
    let mut rest = values.clone();
    basis.iter().for_each(|b| take_out(&mut rest, b));
    (squares(&rest) > INDEPENDENT * squares(&values)).then_some(Column { covariate, level, scale, values })
}

/// Takes the direction `along`, which is not zero, out of `values`.
fn take_out(values: &mut [f64], along: &[f64]) {
    let length: f64 = along.iter().map(|a| a * a).sum();
    let share = values.iter().zip(along).map(|(v, a)| v * a).sum::<f64>() / length;
    values.iter_mut().zip(along).for_each(|(v, a)| *v -= share * a);
}
