//! First estimates: the equation between windowed integrals, by the algebraic method.
//!
//! Rows of ∫ w (Σ θⱼ zⱼ − f) dτ = 0 over sliding windows, w(τ) = τⁿ (T − τ)ⁿ (see `greybox-algebraic`): the leading
//! derivative and the linear terms come from the measured signal alone, integrated by parts; products
//! are taken of the smoothed states. Errors in these regressors bias the coefficients a little, and the
//! choice of terms with them: that is why what is found here is only where the output error starts.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use greybox_algebraic::{Column, Hold as Join, Kernel, rows_of_pieces};
use greybox_calibrate::{Data, SmoothedStates, qr};
use greybox_model::tape::{Column as Lane, LeafKind, Tape};
use greybox_model::{Expr, Hold, Model};

use crate::choose::Reduced;
use crate::structure::{Integral, Structure};

/// What the weak form sees of one piece.
pub(crate) struct Stretch<'a> {
    /// Sample interval, s.
    dt: f64,
    /// The inputs as they act: each a dead time later than it was recorded.
    inputs: Vec<Cow<'a, [f64]>>,
    /// The measurements.
    measured: Vec<&'a [f64]>,
    /// The measurements smoothed.
    smooth: Vec<&'a [f64]>,
    /// The smoothed states, where a channel measures them.
    states: Vec<Option<&'a [f64]>>,
}

impl Stretch<'_> {
    fn len(&self) -> usize {
        self.measured.first().map_or(0, |m| m.len())
    }
}

/// The pieces with the input i `late[i]` seconds late, without the first `skip` seconds of each.
///
/// Between samples a late input is read off a straight line. Where it is linear between its samples, that is the input;
/// where it is held, it is the mean over the interval, so that its integral is that of the input.
pub(crate) fn stretches<'a>(
    data: &'a Data,
    smoothed_states: &'a SmoothedStates,
    late: &[f64],
    skip: f64,
) -> Vec<Stretch<'a>> {
    data.pieces
        .iter()
        .zip(&smoothed_states.states)
        .filter_map(|(piece, states)| {
            let from = (skip / piece.dt).ceil() as usize;
            (from < piece.len).then(|| Stretch {
                dt: piece.dt,
                inputs: piece
                    .inputs
                    .iter()
                    .zip(late)
                    .map(|(u, late)| match *late > 0.0 {
                        true => Cow::Owned(earlier(u, piece.dt, *late).split_off(from)),
                        false => Cow::Borrowed(&u[from..]),
                    })
                    .collect(),
                measured: piece.measured.iter().map(|y| &y[from..]).collect(),
                smooth: piece.smooth.iter().map(|y| &y.value[from..]).collect(),
                states: states.iter().map(|x| x.as_ref().map(|x| &x[from..])).collect(),
            })
        })
        .collect()
}

/// Columns of one equation's regression.
pub(crate) struct Rows {
    /// One column per candidate of the equation, in the order of the structure's terms.
    pub columns: Vec<Vec<f64>>,
    /// The input's column (all zero without input).
    pub target: Vec<f64>,
    /// Index of each candidate among the structure's terms.
    pub terms: Vec<usize>,
    /// The delayed state's column, where the equation has one.
    pub delayed: Option<Vec<f64>>,
    /// Windows without overlap among the rows.
    pub independent: f64,
    /// Rows that share samples with one row, on one side.
    pub overlap: usize,
    /// Row ranges of the pieces.
    pub pieces: Vec<Range<usize>>,
}

/// A delayed feedback, its delay held at a trial value.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Trial {
    /// The delayed state.
    pub state: usize,
    /// The delay, s.
    pub delay: f64,
    /// The gain where it is known.
    pub gain: Option<f64>,
}

/// `signal` a time `delay` earlier, its first sample held before the start.
fn earlier(signal: &[f64], dt: f64, delay: f64) -> Vec<f64> {
    let shift = delay / dt;
    (0..signal.len())
        .map(|k| {
            let at = (k as f64 - shift).max(0.0);
            let (i, w) = (at.floor() as usize, at.fract());
            let next = signal[(i + 1).min(signal.len() - 1)];
            signal[i] + w * (next - signal[i])
        })
        .collect()
}

/// Signals along the smoothed states.
pub(crate) struct Signals<'a> {
    stretches: Vec<Stretch<'a>>,
    /// Index of each signal.
    index: BTreeMap<String, usize>,
    /// `[stretch][signal][sample]`.
    values: Vec<Vec<Vec<f64>>>,
}

/// Values of all signals that the candidate terms integrate.
pub(crate) fn evaluate<'a>(
    structure: &Structure,
    model: &Model,
    stretches: Vec<Stretch<'a>>,
) -> Option<Signals<'a>> {
    let orders: Vec<usize> = model.states.iter().map(|s| s.order).collect();
    let offsets: Vec<usize> = orders
        .iter()
        .scan(0, |sum, o| {
            let at = *sum;
            *sum += o;
            Some(at)
        })
        .collect();
    let nx: usize = orders.iter().sum();
    let resolve = |name: &str, primes: u8| -> Option<usize> {
        let primes = primes as usize;
        if let Some(j) = model.states.iter().position(|s| s.name == name) {
            return (primes < orders[j]).then(|| offsets[j] + primes);
        }
        let input = model.inputs.iter().position(|u| u.name == name)?;
        (primes == 0).then_some(nx + input)
    };
    let parts = structure.terms.iter().flat_map(|t| &t.parts);
    let signals: BTreeSet<&String> = parts.flat_map(|p| &p.integrals).map(|i| &i.signal).collect();
    let exprs: Vec<Expr> = signals
        .iter()
        .map(|signal| greybox_model::parse(signal).ok().map(|p| p.expr))
        .collect::<Option<_>>()?;
    let index = signals.into_iter().enumerate().map(|(i, signal)| (signal.clone(), i)).collect();
    let kinds = vec![LeafKind::Input; nx + model.inputs.len()];
    let tape = Tape::compile(&exprs, kinds, &resolve).ok()?;
    let values = stretches
        .iter()
        .map(|stretch| {
            if stretch.states.iter().any(Option::is_none) {
                return None;
            }
            let leaf = |i: usize| -> Lane<'_> {
                if i < nx {
                    Lane::Series(stretch.states[i].unwrap_or(&[]))
                } else {
                    Lane::Series(&stretch.inputs[i - nx])
                }
            };
            Some(tape.eval_batch(stretch.len(), &leaf))
        })
        .collect::<Option<_>>()?;
    Some(Signals { stretches, index, values })
}

/// How a signal that acts as `hold` says runs between its samples.
fn join(hold: Hold) -> Join {
    match hold {
        Hold::Zero => Join::Zero,
        Hold::Linear => Join::Linear,
        Hold::BandLimited => Join::Smooth,
    }
}

/// Rows of one equation with windows of `window` seconds.
pub(crate) fn rows(
    structure: &Structure,
    model: &Model,
    signals: &Signals<'_>,
    equation: usize,
    window: f64,
    trial: Option<Trial>,
) -> Option<Rows> {
    let stretches = &signals.stretches;
    let dt = stretches.iter().map(|p| p.dt).fold(f64::INFINITY, f64::min);
    let order = model.states[equation].order;
    let intervals = ((window / dt).round() as usize).max(8);
    let kernel = Kernel::new(order, order + 1, intervals, dt).ok()?;
    let hop = (intervals / 20).max(1);
    let terms: Vec<usize> =
        (0..structure.terms.len()).filter(|&i| structure.terms[i].part(equation).is_some()).collect();
    let parts = || terms.iter().filter_map(|&t| structure.terms[t].part(equation));
    let input = structure.equations[equation].input.as_ref().and_then(|name| model.input(name));
    let late: Vec<Vec<f64>> = match trial {
        Some(t) => stretches.iter().map(|p| earlier(p.smooth[t.state], p.dt, t.delay)).collect(),
        None => Vec::new(),
    };
    let zeros: Vec<Vec<f64>> = stretches.iter().map(|p| vec![0.0; p.len()]).collect();
    let pieces: Vec<Vec<Column<'_>>> = stretches
        .iter()
        .enumerate()
        .filter(|(_, p)| (p.dt / dt - 1.0).abs() < 1e-6)
        .map(|(i, piece)| {
            let input_column =
                |u: usize| Column { signal: &piece.inputs[u], order: 0, hold: join(model.inputs[u].hold) };
            let column = |integral: &Integral| -> Column<'_> {
                let state = model.states.iter().position(|s| s.name == integral.signal);
                match (state, model.input(&integral.signal)) {
                    // A derivative of a measured state: from the measurement itself.
                    (Some(j), _) => {
                        Column { signal: piece.measured[j], order: integral.order, hold: Join::Smooth }
                    }
                    (None, Some(u)) => input_column(u),
                    (None, None) => Column {
                        signal: &signals.values[i][signals.index[&integral.signal]],
                        order: integral.order,
                        hold: Join::Smooth,
                    },
                }
            };
            let mut columns: Vec<Column<'_>> = parts().flat_map(|p| &p.integrals).map(column).collect();
            if let Some(signal) = late.get(i) {
                columns.push(Column { signal, order: 0, hold: Join::Linear });
            }
            columns.push(match input {
                Some(u) => input_column(u),
                None => Column { signal: &zeros[i], order: 0, hold: Join::Linear },
            });
            columns
        })
        .collect();
    let mut rows = rows_of_pieces(&kernel, &pieces, hop).ok()?;
    let target = rows.columns.pop()?;
    let delayed = if trial.is_some() { rows.columns.pop() } else { None };
    // A part is the sum of its integrals.
    let mut integrals = rows.columns.into_iter();
    let columns: Vec<Vec<f64>> = parts()
        .map(|part| {
            let mut sum = integrals.next().unwrap_or_default();
            for integral in integrals.by_ref().take(part.integrals.len() - 1) {
                sum.iter_mut().zip(integral).for_each(|(s, v)| *s += v);
            }
            sum
        })
        .collect();
    let overlap = intervals.div_ceil(hop);
    let independent = (target.len() as f64 / overlap as f64).max(1.0);
    Some(Rows { columns, target, terms, delayed, independent, overlap, pieces: ranges(&rows.pieces) })
}

/// Ranges of consecutive rows of the same piece.
fn ranges(piece_of_row: &[usize]) -> Vec<Range<usize>> {
    let mut pieces: Vec<Range<usize>> = Vec::new();
    for (row, piece) in piece_of_row.iter().enumerate() {
        match pieces.last_mut() {
            Some(range) if piece_of_row[range.start] == *piece => range.end = row + 1,
            _ => pieces.push(row..row + 1),
        }
    }
    pieces
}

/// A linear regression, the columns of small orders first.
pub(crate) struct Regression {
    /// Right-hand side.
    pub target: Vec<f64>,
    /// Columns with the candidates they stand for (none: the delayed feedback).
    pub columns: Vec<(Option<usize>, Vec<f64>)>,
    /// Columns that must stay.
    pub protected: Vec<usize>,
}

/// The rows of equations that share coefficients as one regression, each equation weighted by the noise of its rows.
pub(crate) fn regression(structure: &Structure, rows: &[Rows], gain: Option<f64>) -> Regression {
    if let [one] = rows {
        return regression_of_one(structure, one, gain);
    }
    let single: Vec<Regression> = rows.iter().map(|r| regression_of_one(structure, r, gain)).collect();
    // First every equation as large as its leading derivative, then as large as what the fit of all leaves.
    let leading = |rows: &Rows| {
        let at = rows.terms.iter().position(|t| !structure.terms[*t].optional);
        at.map_or(1.0, |at| rms(&rows.columns[at]))
    };
    let scale: Vec<f64> = rows.iter().map(leading).collect();
    let stacked = stack(structure, &single, &scale);
    let left = stacked.residual();
    let mut from = 0;
    let scale: Vec<f64> = scale
        .iter()
        .zip(&single)
        .map(|(scale, of_equation)| {
            let range = from..from + of_equation.target.len();
            from = range.end;
            // Where nothing is left, rounding is.
            scale * rms(&left[range]).max(1e-6)
        })
        .collect();
    if scale.iter().all(|s| s.is_finite()) { stack(structure, &single, &scale) } else { stacked }
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len().max(1) as f64).sqrt().max(f64::MIN_POSITIVE)
}

/// One regression of several, each divided by its `scale`; a column is zero in equations that its term does not enter.
fn stack(structure: &Structure, single: &[Regression], scale: &[f64]) -> Regression {
    let n: usize = single.iter().map(|r| r.target.len()).sum();
    let present: BTreeSet<Option<usize>> =
        single.iter().flat_map(|r| r.columns.iter().map(|c| c.0)).collect();
    let mut columns: Vec<(Option<usize>, Vec<f64>)> =
        present.into_iter().map(|t| (t, vec![0.0; n])).collect();
    let mut target = Vec::with_capacity(n);
    for (regression, scale) in single.iter().zip(scale) {
        let from = target.len();
        target.extend(regression.target.iter().map(|v| v / scale));
        for (term, column) in &regression.columns {
            let Some((_, stacked)) = columns.iter_mut().find(|c| c.0 == *term) else { continue };
            stacked[from..].iter_mut().zip(column).for_each(|(s, v)| *s = v / scale);
        }
    }
    Regression::new(structure, target, columns)
}

impl Regression {
    fn new(
        structure: &Structure,
        target: Vec<f64>,
        mut columns: Vec<(Option<usize>, Vec<f64>)>,
    ) -> Regression {
        let stays = |t: &Option<usize>| t.is_none_or(|t| !structure.terms[t].optional);
        columns.sort_by_key(|c| c.0.map_or(0, |t| structure.terms[t].order));
        let protected = (0..columns.len()).filter(|&c| stays(&columns[c].0)).collect();
        Regression { target, columns, protected }
    }

    /// The triangle of \[columns | target\].
    fn triangle(&self) -> Vec<f64> {
        let (n, k) = (self.target.len(), self.columns.len());
        let mut a = Vec::with_capacity(n * (k + 1));
        self.columns.iter().for_each(|(_, column)| a.extend_from_slice(column));
        a.extend_from_slice(&self.target);
        qr::triangle(&mut a, n, k + 1)
    }

    /// What least squares on all columns leaves of the target.
    fn residual(&self) -> Vec<f64> {
        let (n, k) = (self.target.len(), self.columns.len());
        let all: Vec<usize> = (0..k).collect();
        let values = Reduced::from_triangle(&self.triangle(), k, n as f64, 0.0).solve(&all).values;
        let mut left = self.target.clone();
        for (value, (_, column)) in values.iter().zip(&self.columns) {
            left.iter_mut().zip(column).for_each(|(l, c)| *l -= value * c);
        }
        left
    }
}

/// The rows of one equation as a regression. Where the leading derivative has no coefficient it moves to the right; a
/// delayed feedback does where its gain is known.
fn regression_of_one(structure: &Structure, rows: &Rows, gain: Option<f64>) -> Regression {
    let mut target = rows.target.clone();
    let mut columns: Vec<(Option<usize>, Vec<f64>)> = Vec::new();
    if let Some(delayed) = &rows.delayed {
        match gain {
            Some(gain) => target.iter_mut().zip(delayed).for_each(|(t, v)| *t += gain * v),
            None => columns.push((None, delayed.clone())),
        }
    }
    for (&term, column) in rows.terms.iter().zip(&rows.columns) {
        if structure.has_coefficient(term) {
            columns.push((Some(term), column.clone()));
        } else {
            target.iter_mut().zip(column).for_each(|(t, v)| *t -= v);
        }
    }
    Regression::new(structure, target, columns)
}

/// The regression in triangular form, and the candidates of its columns (none: the delayed feedback).
pub(crate) fn reduce(
    structure: &Structure,
    rows: &[Rows],
    gain: Option<f64>,
) -> (Reduced, Vec<Option<usize>>) {
    let regression = regression(structure, rows, gain);
    let t = regression.triangle();
    let Regression { target, columns, .. } = regression;
    let (n, k) = (target.len(), columns.len());
    let floor = 1e-10 * target.iter().map(|v| v * v).sum::<f64>() / n.max(1) as f64;
    // Rows of overlapping windows share their noise: a window's worth of them counts as one.
    let independent: f64 = rows.iter().map(|r| r.independent).sum();
    let reduced = Reduced::from_triangle(&t, k, n as f64, floor).weighted(independent / n as f64);
    let samples = independent.max(k as f64 + 2.0);
    (Reduced { samples, ..reduced }, columns.into_iter().map(|c| c.0).collect())
}

/// Length of a typical oscillation, s: twice the mean time between crossings of the mean, the shortest
/// over the channels.
pub(crate) fn period(data: &Data) -> f64 {
    (0..data.channels.len())
        .map(|c| {
            let (mut crossings, mut duration) = (0usize, 0.0);
            for piece in &data.pieces {
                let y = &piece.smooth[c].value;
                let mean = y.iter().sum::<f64>() / y.len() as f64;
                let band = 0.1 * data.spread[c];
                let mut side = 0i8;
                for v in y {
                    let now = if v - mean > band {
                        1
                    } else if v - mean < -band {
                        -1
                    } else {
                        side
                    };
                    crossings += usize::from(side != 0 && now != side);
                    side = now;
                }
                duration += piece.len as f64 * piece.dt;
            }
            2.0 * duration / crossings.max(2) as f64
        })
        .fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::structure::Term;

    fn term(order: usize, optional: bool) -> Term {
        Term { parts: Vec::new(), parameter: String::new(), powers: Vec::new(), order, even: false, optional }
    }

    /// A structure with these terms and nothing else.
    fn of(terms: Vec<Term>) -> Structure {
        let (inputs, states, equations) = (Vec::new(), Vec::new(), Vec::new());
        let (extras, dead_times) = (Vec::new(), Vec::new());
        Structure { title: String::new(), inputs, states, equations, terms, extras, dead_times }
    }

    #[test]
    fn columns_stand_in_the_order_of_the_library_whatever_that_of_the_terms() {
        // Terms of energies have order one and come last.
        let structure = of(vec![term(1, false), term(1, true), term(3, true), term(1, true)]);
        let columns = [Some(0), Some(1), Some(2), Some(3), None].map(|t| (t, vec![0.0])).to_vec();
        let regression = Regression::new(&structure, vec![0.0], columns);
        let order: Vec<Option<usize>> = regression.columns.iter().map(|c| c.0).collect();
        assert_eq!(order, [None, Some(0), Some(1), Some(3), Some(2)]);
        assert_eq!(regression.protected, [0, 1], "the delayed feedback and the leading derivative stay");
    }

    #[test]
    fn equations_are_stacked_with_zeros_where_a_term_does_not_enter() {
        let structure = of(vec![term(1, true), term(1, true)]);
        let first = Regression::new(
            &structure,
            vec![2.0, 4.0],
            vec![(Some(0), vec![6.0, 8.0]), (Some(1), vec![1.0, 2.0])],
        );
        let second = Regression::new(&structure, vec![9.0], vec![(Some(1), vec![3.0])]);
        let stacked = stack(&structure, &[first, second], &[2.0, 3.0]);
        assert_eq!(stacked.target, [1.0, 2.0, 3.0]);
        assert_eq!(stacked.columns, [(Some(0), vec![3.0, 4.0, 0.0]), (Some(1), vec![0.5, 1.0, 1.0])]);
        assert!(stacked.residual().iter().all(|v| v.is_finite()));
    }
}
