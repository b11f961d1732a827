//! First estimates: the equation between windowed integrals, by the algebraic method.
//!
//! Rows of ∫ w (Σ θⱼ zⱼ − f) dτ = 0 over sliding windows, w(τ) = τⁿ (T − τ)ⁿ (see `greybox-algebraic`): the leading
//! derivative and the linear terms come from the measured signal alone, integrated by parts; products
//! are taken of the smoothed states. Errors in these regressors bias the coefficients a little, and the
//! choice of terms with them: that is why what is found here is only where the output error starts.

use greybox_algebraic::{Column, Hold as Join, Kernel, rows_of_pieces};
use greybox_calibrate::{Data, SmoothedStates, qr};
use greybox_model::tape::{Column as Lane, LeafKind, Tape};
use greybox_model::{Expr, Hold, Model};

use crate::choose::Reduced;
use crate::structure::Structure;

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
    pub pieces: Vec<std::ops::Range<usize>>,
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

/// Values of all candidate terms along the smoothed states, `[piece][term][sample]`.
pub(crate) fn evaluate(
    structure: &Structure,
    model: &Model,
    data: &Data,
    smoothed_states: &SmoothedStates,
) -> Option<Vec<Vec<Vec<f64>>>> {
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
    let exprs: Vec<Expr> = structure
        .terms
        .iter()
        .map(|t| {
            let text = if t.optional { t.expression.as_str() } else { "0" };
            greybox_model::parse(text).ok().map(|p| p.expr)
        })
        .collect::<Option<_>>()?;
    let kinds = vec![LeafKind::Input; nx + model.inputs.len()];
    let tape = Tape::compile(&exprs, kinds, &resolve).ok()?;
    data.pieces
        .iter()
        .zip(&smoothed_states.states)
        .map(|(piece, smoothed_states)| {
            if smoothed_states.iter().any(Option::is_none) {
                return None;
            }
            let leaf = |i: usize| -> Lane<'_> {
                if i < nx {
                    Lane::Series(smoothed_states[i].as_deref().unwrap_or(&[]))
                } else {
                    Lane::Series(&piece.inputs[i - nx])
                }
            };
            Some(tape.eval_batch(piece.len, &leaf))
        })
        .collect()
}

/// Rows of one equation with windows of `window` seconds.
pub(crate) fn rows(
    structure: &Structure,
    model: &Model,
    data: &Data,
    values: &[Vec<Vec<f64>>],
    equation: usize,
    window: f64,
    trial: Option<Trial>,
) -> Option<Rows> {
    let dt = data.pieces.iter().map(|p| p.dt).fold(f64::INFINITY, f64::min);
    let order = model.states[equation].order;
    let intervals = ((window / dt).round() as usize).max(8);
    let kernel = Kernel::new(order, order + 1, intervals, dt).ok()?;
    let hop = (intervals / 20).max(1);
    let terms: Vec<usize> =
        (0..structure.terms.len()).filter(|&i| structure.terms[i].equation == equation).collect();
    let input = structure.equations[equation].input.as_ref().and_then(|name| model.input(name));
    let late: Vec<Vec<f64>> = match trial {
        Some(t) => data.pieces.iter().map(|p| earlier(&p.smooth[t.state].value, p.dt, t.delay)).collect(),
        None => Vec::new(),
    };
    let zeros: Vec<Vec<f64>> = data.pieces.iter().map(|p| vec![0.0; p.len]).collect();
    let state_of = |expression: &str| -> Option<(usize, usize)> {
        let name = expression.trim_end_matches('\'');
        let primes = expression.len() - name.len();
        model.states.iter().position(|s| s.name == name).map(|j| (j, primes))
    };
    let pieces: Vec<Vec<Column<'_>>> = data
        .pieces
        .iter()
        .enumerate()
        .filter(|(_, p)| (p.dt / dt - 1.0).abs() < 1e-6)
        .map(|(i, piece)| {
            let mut columns: Vec<Column<'_>> = terms
                .iter()
                .map(|&t| match state_of(&structure.terms[t].expression) {
                    // A derivative of a measured state: from the measurement itself.
                    Some((j, primes)) => {
                        Column { signal: &piece.measured[j], order: primes, hold: Join::Smooth }
                    }
                    None => Column { signal: &values[i][t], order: 0, hold: Join::Smooth },
                })
                .collect();
            if let Some(signal) = late.get(i) {
                columns.push(Column { signal, order: 0, hold: Join::Linear });
            }
            columns.push(match input {
                Some(u) => Column {
                    signal: &piece.inputs[u],
                    order: 0,
                    hold: match model.inputs[u].hold {
                        Hold::Zero => Join::Zero,
                        Hold::Linear => Join::Linear,
                        Hold::BandLimited => Join::Smooth,
                    },
                },
                None => Column { signal: &zeros[i], order: 0, hold: Join::Linear },
            });
            columns
        })
        .collect();
    let mut rows = rows_of_pieces(&kernel, &pieces, hop).ok()?;
    let target = rows.columns.pop()?;
    let delayed = if trial.is_some() { rows.columns.pop() } else { None };
    let overlap = intervals.div_ceil(hop);
    let independent = (target.len() as f64 / overlap as f64).max(1.0);
    let mut pieces: Vec<std::ops::Range<usize>> = Vec::new();
    for (row, piece) in rows.pieces.iter().enumerate() {
        match pieces.last_mut() {
            Some(range) if rows.pieces[range.start] == *piece => range.end = row + 1,
            _ => pieces.push(row..row + 1),
        }
    }
    Some(Rows { columns: rows.columns, target, terms, delayed, independent, overlap, pieces })
}

/// A linear regression.
pub(crate) struct Regression {
    /// Right-hand side.
    pub target: Vec<f64>,
    /// Columns with the candidates they stand for (none: the delayed feedback).
    pub columns: Vec<(Option<usize>, Vec<f64>)>,
    /// Columns that must stay.
    pub protected: Vec<usize>,
}

/// The rows as a regression. Without input the leading derivative moves to the right; a delayed feedback does where its gain is known.
pub(crate) fn regression(structure: &Structure, rows: &Rows, gain: Option<f64>) -> Regression {
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
    let stays = |t: &Option<usize>| t.is_none_or(|t| !structure.terms[t].optional);
    let protected = (0..columns.len()).filter(|&c| stays(&columns[c].0)).collect();
    Regression { target, columns, protected }
}

/// The regression in triangular form, and the candidates of its columns (none: the delayed feedback).
pub(crate) fn reduce(structure: &Structure, rows: &Rows, gain: Option<f64>) -> (Reduced, Vec<Option<usize>>) {
    let Regression { target, columns, .. } = regression(structure, rows, gain);
    let n = target.len();
    let k = columns.len();
    let mut a = Vec::with_capacity(n * (k + 1));
    for (_, column) in &columns {
        a.extend_from_slice(column);
    }
    a.extend_from_slice(&target);
    let t = qr::triangle(&mut a, n, k + 1);
    let floor = 1e-10 * target.iter().map(|v| v * v).sum::<f64>() / n.max(1) as f64;
    // Rows of overlapping windows share their noise: a window's worth of them counts as one.
    let reduced = Reduced::from_triangle(&t, k, n as f64, floor).weighted(rows.independent / n as f64);
    let samples = rows.independent.max(k as f64 + 2.0);
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
