//! Expressions of the model evaluated along given states, sample by sample.

use greybox_calibrate::{FitPoint, PieceData, Segmentation, Setup};
use greybox_model::tape::{Column, LeafKind, Tape};
use greybox_model::{Expr, Func};

/// States of every piece at every sample, from the measurements where there are any.
pub struct TrajectoryEval<'a> {
    setup: &'a Setup,
    /// `states[piece][i]` is entry i of the state vector.
    pub states: Vec<Vec<Vec<f64>>>,
    parameters: Vec<f64>,
    simulated: bool,
}

/// Writes the segments' own trajectories over the entries of `states[piece][entry][sample]` that `entry` picks.
fn follow(states: &mut [Vec<Vec<f64>>], at: FitPoint<'_>, entry: impl Fn(usize) -> bool) {
    let FitPoint { setup, level, scale, point } = at;
    let rows = setup.with_problem(level, scale, |p| p.rows(point, false, None));
    for (segment, rows) in level.segments.iter().zip(&rows) {
        let t = &rows.trajectory;
        for i in (0..setup.system.nx).filter(|i| entry(*i)) {
            states[segment.piece][i][segment.range.clone()].copy_from_slice(&t.x[i * t.n..(i + 1) * t.n]);
        }
    }
}

impl<'a> TrajectoryEval<'a> {
    /// Smoothed by model and measurements together ([`crate::smoother`]): states, and the force that each
    /// equation lacks. Beside coloured noise the states are those of the fit itself: what the model still lacks
    /// moves them less than the noise does, and noise in a candidate's variables would pass for its effect.
    pub fn observed(at: FitPoint<'a>) -> (TrajectoryEval<'a>, Vec<Vec<Vec<f64>>>) {
        let FitPoint { setup, point, .. } = at;
        let first = TrajectoryEval::smoothed(at);
        let force: Vec<f64> = first
            .own_forces()
            .into_iter()
            .enumerate()
            .map(|(e, f)| {
                // A mechanism's own equation is exact.
                let memory = setup.carried.iter().any(|&i| {
                    let j = setup.model.state(&setup.model.equations[e].name);
                    j.is_some_and(|j| setup.system.offsets[j] == i)
                });
                if memory { 0.0 } else { f }
            })
            .collect();
        let given = crate::smoother::Assumptions {
            parameters: &point.parameters,
            noise: &setup.data.sigma,
            force: &force,
            first: &first.states,
            tolerance: &setup.smoothed_states.tolerance,
        };
        let smoothed = crate::smoother::smooth(setup, &given);
        let along = if setup.noise.is_some() {
            TrajectoryEval::undisturbed(at)
        } else {
            TrajectoryEval { states: smoothed.states, ..first }
        };
        (along, smoothed.forces)
    }

    /// RMS of each equation's terms without highest derivatives, in quadrature.
    fn own_forces(&self) -> Vec<f64> {
        let model = &self.setup.model;
        let highest = |t: &Expr| {
            t.variables()
                .iter()
                .any(|(n, p)| model.state(n).is_some_and(|j| usize::from(*p) >= model.states[j].order))
        };
        let size = |equation: &greybox_model::Equation| {
            let residual = equation.residual();
            let own: Vec<Expr> =
                residual.terms().into_iter().map(|(_, t)| t.clone()).filter(|t| !highest(t)).collect();
            let Some(values) = self.eval(&own, &[]) else { return 0.0 };
            let (mut sum, mut count) = (0.0, 0usize);
            for v in values.iter().flatten().flatten().filter(|v| v.is_finite()) {
                sum += v * v;
                count += 1;
            }
            (sum * own.len() as f64 / count.max(1) as f64).sqrt()
        };
        model.equations.iter().map(size).collect()
    }

    /// RMS of all that each equation balances: its terms in quadrature, those with highest derivatives from the smoothed
    /// measurements.
    pub fn total_forces(&self) -> Vec<f64> {
        let (model, own) = (&self.setup.model, self.own_forces());
        let highest: Vec<(&str, u8)> =
            model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let inertial = |equation: &greybox_model::Equation| -> f64 {
            let Some((mass, _)) = equation.residual().affine_in(&highest) else { return 0.0 };
            let Some(values) = self.eval(&mass, &[]) else { return 0.0 };
            let (mut sum, mut count) = (0.0, 0usize);
            for (j, column) in values.iter().enumerate() {
                for (p, column) in column.iter().enumerate() {
                    let Some(z) = &self.setup.smoothed_states.highest[p][j] else { continue };
                    for v in column.iter().zip(z).map(|(c, z)| c * z).filter(|v| v.is_finite()) {
                        sum += v * v;
                        count += 1;
                    }
                }
            }
            (sum * mass.len() as f64 / count.max(1) as f64).sqrt()
        };
        model.equations.iter().zip(own).map(|(e, own)| own.hypot(inertial(e))).collect()
    }

    /// Smoothed measurements; unmeasured entries from the segments' trajectories.
    pub fn smoothed(at: FitPoint<'a>) -> TrajectoryEval<'a> {
        TrajectoryEval::measured(at, false)
    }

    /// Smoothed measurements, or beside coloured noise, which they hold, the segments' trajectories.
    pub fn undisturbed(at: FitPoint<'a>) -> TrajectoryEval<'a> {
        let FitPoint { setup, .. } = at;
        TrajectoryEval::measured(at, setup.noise.is_some())
    }

    /// Smoothed measurements; on the segments of `level` all entries (`simulated`) or the unmeasured ones from
    /// their own trajectories.
    fn measured(at: FitPoint<'a>, simulated: bool) -> TrajectoryEval<'a> {
        let FitPoint { setup, point, .. } = at;
        let own = |i: usize| simulated || setup.smoothed_states.tolerance[i].is_infinite();
        let mut states: Vec<Vec<Vec<f64>>> = setup
            .data
            .pieces
            .iter()
            .zip(&setup.smoothed_states.states)
            .map(|(piece, smoothed_states)| {
                smoothed_states.iter().map(|h| h.clone().unwrap_or_else(|| vec![0.0; piece.len])).collect()
            })
            .collect();
        if (0..setup.system.nx).any(own) {
            follow(&mut states, at, own);
        }
        TrajectoryEval { setup, states, parameters: point.parameters.clone(), simulated }
    }

    /// Simulated states, `x[piece][i * n + k]`.
    pub fn simulated(setup: &'a Setup, x: &[Vec<f64>], parameters: &[f64]) -> TrajectoryEval<'a> {
        let states = x
            .iter()
            .zip(&setup.data.pieces)
            .map(|(x, piece)| x.chunks(piece.len).map(<[f64]>::to_vec).collect())
            .collect();
        TrajectoryEval { setup, states, parameters: parameters.to_vec(), simulated: true }
    }

    /// Highest derivatives `[piece][state][sample]`: smoothed where the state is measured, else what the
    /// model's own equations say.
    fn highest(&self) -> Option<Vec<Vec<Vec<f64>>>> {
        let (model, nz) = (&self.setup.model, self.setup.system.nz);
        let symbols: Vec<(&str, u8)> =
            model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let mut exprs = Vec::new();
        for equation in &model.equations {
            let (mass, rest) = equation.residual().affine_in(&symbols)?;
            exprs.extend(mass);
            exprs.push(rest);
        }
        let values = self.eval(&exprs, &[])?;
        let smoothed = !self.simulated;
        Some(
            (0..self.states.len())
                .map(|p| {
                    let n = self.setup.data.pieces[p].len;
                    let mut z = vec![vec![0.0; n]; nz];
                    let mut a = vec![0.0; nz * nz];
                    let mut b = vec![0.0; nz];
                    let mut pivots = vec![0; nz];
                    for k in 0..n {
                        for e in 0..nz {
                            for j in 0..nz {
                                a[e * nz + j] = values[e * (nz + 1) + j][p][k];
                            }
                            b[e] = -values[e * (nz + 1) + nz][p][k];
                        }
                        greybox_simulate::small::factor(&mut a, &mut pivots, nz);
                        greybox_simulate::small::solve(&a, &pivots, nz, &mut b, 1);
                        for j in 0..nz {
                            z[j][k] = b[j];
                        }
                    }
                    if smoothed {
                        for (z, hat) in z.iter_mut().zip(&self.setup.smoothed_states.highest[p]) {
                            if let Some(hat) = hat {
                                z.clone_from(hat);
                            }
                        }
                    }
                    z
                })
                .collect(),
        )
    }

    /// Values of `exprs` (states, inputs, parameters of the model, `extra` names), as
    /// `[expr][piece][sample]`; `None` when an expression mentions anything else. Every function is
    /// evaluated pointwise, with sign(0) = 0.
    pub fn eval(&self, exprs: &[Expr], extra: &[(&str, f64)]) -> Option<Vec<Vec<Vec<f64>>>> {
        self.eval_on(&Cover::default(), exprs, extra)
    }

    /// [`eval`](Self::eval) at the samples of a cover alone, one after the other.
    pub(crate) fn eval_on(
        &self,
        cover: &Cover,
        exprs: &[Expr],
        extra: &[(&str, f64)],
    ) -> Option<Vec<Vec<Vec<f64>>>> {
        let model = &self.setup.model;
        let system = &self.setup.system;
        let base = system.delayed();
        // Delayed expressions become leaves of their own: evaluated first, then shifted.
        let mut delays: Vec<(Expr, Expr)> = Vec::new();
        let rewritten: Vec<Expr> = exprs
            .iter()
            .map(|e| {
                e.map(&mut |node| match &node {
                    Expr::Call(Func::Delay, args) => {
                        // A delay within a delay is evaluated with it.
                        let args: Vec<Expr> = args.iter().map(|arg| with_delays(arg, &delays)).collect();
                        let found = delays.iter().position(|d| d.0 == args[0] && d.1 == args[1]);
                        let i = found.unwrap_or_else(|| {
                            delays.push((args[0].clone(), args[1].clone()));
                            delays.len() - 1
                        });
                        Expr::var(&format!("delayed#{i}"))
                    }
                    _ => node,
                })
            })
            .collect();
        let resolve = |name: &str, primes: u8| -> Option<usize> {
            if let Some(i) = name.strip_prefix("delayed#") {
                return i.parse::<usize>().ok().map(|i| base + extra.len() + i);
            }
            if let Some(i) = extra.iter().position(|e| e.0 == name) {
                return (primes == 0).then_some(base + i);
            }
            if let Some(j) = model.state(name) {
                return match (primes as usize).cmp(&system.orders[j]) {
                    std::cmp::Ordering::Less => Some(1 + system.offsets[j] + primes as usize),
                    std::cmp::Ordering::Equal => Some(system.highest() + j),
                    std::cmp::Ordering::Greater => None,
                };
            }
            if primes > 0 {
                return None;
            }
            if let Some(i) = model.input(name) {
                return Some(system.inputs() + i);
            }
            if let Some(i) = model.parameter(name) {
                return Some(system.parameters() + i);
            }
            (name == "t").then_some(0)
        };
        let shifted: Vec<Vec<Vec<f64>>> = delays
            .iter()
            .map(|(arg, tau)| {
                let mut values = self.eval(&[arg.clone(), tau.clone()], extra)?;
                let taus = values.pop()?;
                let args = values.pop()?;
                Some(
                    args.iter()
                        .zip(&taus)
                        .zip(&self.setup.data.pieces)
                        .map(|((a, tau), piece)| shift(a, tau.first().copied().unwrap_or(0.0) / piece.dt))
                        .collect(),
                )
            })
            .collect::<Option<_>>()?;
        let mut kinds = vec![LeafKind::Varying; base];
        kinds.extend(std::iter::repeat_n(LeafKind::Parameter, extra.len()));
        kinds.extend(std::iter::repeat_n(LeafKind::Varying, delays.len()));
        let tape = Tape::compile(&rewritten, kinds, &resolve).ok()?;
        let highest = exprs.iter().any(|e| {
            let used = e.variables();
            used.iter().any(|(n, p)| model.state(n).is_some_and(|j| *p as usize == system.orders[j]))
        });
        let highest = if highest { self.highest()? } else { Vec::new() };
        let mut out = vec![Vec::with_capacity(self.states.len()); exprs.len()];
        for (i, piece) in self.setup.data.pieces.iter().enumerate() {
            let time: Vec<f64> = (0..piece.len).map(|k| piece.start + k as f64 * piece.dt).collect();
            let series = |leaf: usize| -> Option<&[f64]> {
                if leaf == 0 {
                    Some(&time)
                } else if leaf < 1 + system.nx {
                    Some(&self.states[i][leaf - 1])
                } else if leaf < system.inputs() {
                    highest.get(i).map(|z| &*z[leaf - system.highest()])
                } else if leaf < system.parameters() {
                    Some(&piece.inputs[leaf - system.inputs()])
                } else {
                    leaf.checked_sub(base + extra.len()).map(|delayed| &*shifted[delayed][i])
                }
            };
            let value = |leaf: usize| {
                let parameter = self.parameters.get(leaf.wrapping_sub(system.parameters()));
                leaf.checked_sub(base).map_or_else(|| parameter.copied().unwrap_or(0.0), |own| extra[own].1)
            };
            let picked: Vec<Option<Vec<f64>>> =
                (0..base + extra.len() + delays.len()).map(|leaf| cover.pick(i, series(leaf)?)).collect();
            let len = cover.samples(i).map_or(piece.len, <[u32]>::len);
            let columns = tape.eval_batch(len, &|leaf| match (&picked[leaf], series(leaf)) {
                (Some(picked), _) => Column::Series(picked),
                (None, Some(series)) => Column::Series(series),
                (None, None) => Column::Value(value(leaf)),
            });
            for (o, c) in out.iter_mut().zip(columns) {
                o.push(c);
            }
        }
        Some(out)
    }
}

/// The samples that a simulation of some segments sees, those behind the segments among them; of a piece that most of them see, and
/// without segments, all.
#[derive(Debug, Clone, Default)]
pub(crate) struct Cover {
    /// Per piece, ascending.
    samples: Vec<Option<Vec<u32>>>,
}

/// Share of a piece from which all of it is covered.
const MOSTLY: f64 = 0.5;

impl Cover {
    /// Of the segments of a level.
    pub(crate) fn of(setup: &Setup, level: &Segmentation) -> Cover {
        let of = |(p, piece): (usize, &PieceData)| {
            let mut seen = vec![false; piece.len];
            for segment in level.segments.iter().filter(|s| s.piece == p) {
                seen[segment.range.start..(segment.range.end + 1).min(piece.len)].fill(true);
            }
            let samples: Vec<u32> = (0..).zip(&seen).filter(|s| *s.1).map(|s| s.0).collect();
            ((samples.len() as f64) < MOSTLY * piece.len as f64).then_some(samples)
        };
        Cover { samples: setup.data.pieces.iter().enumerate().map(of).collect() }
    }

    /// The samples of a piece; `None`: all of them.
    pub(crate) fn samples(&self, piece: usize) -> Option<&[u32]> {
        self.samples.get(piece)?.as_deref()
    }

    /// What a series of a whole piece is at its samples; `None`: it is wanted whole.
    pub(crate) fn pick(&self, piece: usize, series: &[f64]) -> Option<Vec<f64>> {
        Some(self.samples(piece)?.iter().map(|k| series[*k as usize]).collect())
    }

    /// For each sample of a piece of so many the row of a table that has a row for each of its samples; of one that it does not
    /// cover, the row before. Empty where all are covered.
    pub(crate) fn rows(&self, piece: usize, len: usize) -> Vec<u32> {
        let Some(samples) = self.samples(piece) else { return Vec::new() };
        let mut rows = Vec::with_capacity(len);
        for k in 0..len as u32 {
            let next = rows.last().map_or(0, |last: &u32| last + 1);
            let is_next = samples.get(next as usize) == Some(&k);
            rows.push(if is_next { next } else { next.saturating_sub(1) });
        }
        rows
    }
}

/// An expression with its delays written out again, where leaves stand for them.
fn with_delays(e: &Expr, delays: &[(Expr, Expr)]) -> Expr {
    e.map(&mut |node| {
        let index = match &node {
            Expr::Var { name, .. } => name.strip_prefix("delayed#").and_then(|i| i.parse::<usize>().ok()),
            _ => None,
        };
        match index.and_then(|i| delays.get(i)) {
            Some((signal, lag)) => Expr::Call(Func::Delay, vec![signal.clone(), lag.clone()]),
            None => node,
        }
    })
}

/// A signal delayed by `lag` samples (linear interpolation, first value held before the start).
fn shift(u: &[f64], lag: f64) -> Vec<f64> {
    (0..u.len())
        .map(|k| {
            let at = (k as f64 - lag).clamp(0.0, (u.len() - 1) as f64);
            let i = (at.floor() as usize).min(u.len().saturating_sub(2));
            let w = at - i as f64;
            u[i] + w * (u.get(i + 1).unwrap_or(&u[i]) - u[i])
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use greybox_calibrate::{Data, free_parameters};
    use greybox_model::Model;

    use super::*;

    #[test]
    fn a_sample_that_is_not_covered_has_the_row_before() {
        let cover = Cover { samples: vec![Some(vec![2, 3, 6]), None] };
        assert_eq!(cover.rows(0, 8), [0, 0, 0, 1, 1, 1, 2, 2]);
        assert_eq!(cover.pick(0, &[9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0]), Some(vec![7.0, 6.0, 3.0]));
        assert!(cover.rows(1, 8).is_empty() && cover.pick(1, &[1.0]).is_none());
        assert!(Cover::default().rows(3, 8).is_empty());
    }

    #[test]
    fn a_delay_within_a_delay_delays_twice() {
        let text = "[states]\nx = { unit = \"m\" }\n[parameters]\nk = { value = 1.0, unit = \"1/s\" }\n\
                    [equations]\nfall = \"x' + k*x = 0\"\n";
        let model = Model::from_toml(text, "m.toml").unwrap();
        let rows: String = (0..60).map(|k| format!("{},{}\n", 0.1 * f64::from(k), k * k)).collect();
        let recording = greybox_recording::parse_csv(format!("t,x\n{rows}").as_bytes(), "r.csv").unwrap();
        let data = Arc::new(Data::new(&model, &[recording]).unwrap());
        let setup = Setup::new(&model, data, free_parameters(&model)).unwrap();
        let x: Vec<f64> = (0..60).map(|k| f64::from(k * k)).collect();
        let along = TrajectoryEval::simulated(&setup, std::slice::from_ref(&x), &[1.0]);
        let delay = |e: Expr, by: f64| Expr::Call(Func::Delay, vec![e, Expr::Num(by)]);
        let nested = delay(delay(Expr::var("x"), 0.2), 0.3);
        let values = along.eval(&[nested, Expr::var("x")], &[]).unwrap();
        for k in 6..60 {
            assert!((values[0][0][k] - x[k - 5]).abs() < 1e-9, "{k}: {} {}", values[0][0][k], x[k - 5]);
        }
    }
}
