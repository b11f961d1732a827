//! Fits of models with mechanisms: how one is assembled, extended or reduced by a law, and which are physical.

use std::cell::LazyCell;

use greybox_calibrate::{FitPoint, FreeParameter, Point, Segmentation, Setup, free_parameters};
use greybox_model::system::CompileError;
use greybox_model::{Hold, Model};

use super::{STEPS_WITHOUT, Search, limits, longest, same_level};
use crate::candidate::{Candidate, Instance};
use crate::evidence::effective_sample_ratio;
use crate::fitted::{FittedModel, Law, MechanismTerm, laws};
use crate::library::Mechanism;
use crate::screen::{Scored, Together, first_states};
use crate::trajectory::TrajectoryEval;
use crate::uncertainty::Uncertainty;

/// Starting points of a mechanism with a memory that are followed, and for how many steps.
const STARTING_POINTS: usize = 3;
const STEPS_TO_TELL: usize = 3;
/// Log-likelihood gain that another hold must bring.
const HOLD_GAIN: f64 = 10.0;

impl Search<'_> {
    /// The nominal equations plus `parts` (candidate, values, sizes), parameters at `parameters`.
    pub(crate) fn assemble(
        &self,
        holds: &[Hold],
        parameters: &[f64],
        parts: &[Law],
        from: &Setup,
    ) -> Result<(Setup, Vec<MechanismTerm>), CompileError> {
        let mut model: Model = self.nominal.model.clone();
        for (input, hold) in model.inputs.iter_mut().zip(holds) {
            input.hold = *hold;
        }
        let mut free: Vec<FreeParameter> = free_parameters(&self.nominal.model);
        for (p, v) in model.parameters.iter_mut().zip(parameters) {
            p.value = *v;
        }
        let mut out = Vec::new();
        for (candidate, values, scales) in parts {
            let mechanism = &self.library[candidate.mechanism];
            let first = model.parameters.len();
            let instance = candidate.insert(&mut model, mechanism, values);
            free.extend(candidate.free(mechanism, first, scales));
            out.push(MechanismTerm { candidate: candidate.clone(), instance, scales: scales.clone() });
        }
        let memory: Vec<String> =
            out.iter().flat_map(|p: &MechanismTerm| p.instance.states.clone()).collect();
        let setup = from.with_model(model, free)?;
        // The names come from the model itself.
        let setup = setup.with_carried(&memory).unwrap_or(setup);
        Ok((setup, out))
    }

    /// A model whose free shapes are tables, with the numbers of their functions, and the instances of its parts in it. `None`
    /// where it has none.
    pub(crate) fn tabulated(&self, fitted: &FittedModel) -> Option<(Model, Vec<Instance>)> {
        let law = |part: &MechanismTerm| &self.library[part.candidate.mechanism];
        if !fitted.parts.iter().any(|part| law(part).shape.is_some()) {
            return None;
        }
        let mut model = self.nominal().model.clone();
        model.inputs.iter_mut().zip(&fitted.setup.holds).for_each(|(input, hold)| input.hold = *hold);
        let values = &fitted.fit.point.parameters;
        model.parameters.iter_mut().zip(values).for_each(|(p, v)| p.value = *v);
        let mut instances = Vec::new();
        for part in &fitted.parts {
            let value = |name: &String| fitted.setup.model.parameter(name).map(|i| values[i]);
            let own: Vec<f64> = part.instance.names.iter().map(value).collect::<Option<_>>()?;
            let first = model.parameters.len();
            instances.push(match law(part).tabulated(&own) {
                Some((table, left)) => {
                    let instance = part.candidate.insert(&mut model, &table, &left);
                    model.parameters[first].fixed = true; // what the knots are multiples of
                    instance
                }
                None => part.candidate.insert(&mut model, law(part), &own),
            });
        }
        let _ = model.resolve_units();
        Some((model, instances))
    }

    /// The laws of a fitted model with their present values.
    pub(crate) fn laws(&self, fitted: &FittedModel) -> Vec<Law> {
        laws(&fitted.parts, &fitted.setup.model, &fitted.fit.point.parameters)
    }

    /// An integration method whose error is a fiftieth of the residual.
    pub(crate) fn method(&self, fitted: &mut FittedModel, scale: &[f64]) {
        for (p, v) in fitted.setup.model.parameters.iter_mut().zip(&fitted.fit.point.parameters) {
            p.value = *v;
        }
        let tolerance: Vec<f64> = scale.iter().map(|s| 0.02 * s).collect();
        fitted.setup.choose_method(&tolerance, longest(&fitted.level));
    }

    /// The model fitted at another level, from the stitched trajectory or the measurements.
    pub(super) fn relevel(
        &self,
        fitted: &FittedModel,
        level: Segmentation,
        scale: &[f64],
        iterations: usize,
    ) -> FittedModel {
        let level = same_level(&fitted.setup, &level);
        let fit = fitted.setup.lengthen(&fitted.level, &fitted.fit.point, &level, scale, limits(iterations));
        FittedModel { level, fit, ..fitted.clone() }
    }

    pub(crate) fn refit(&self, fitted: &FittedModel, scale: &[f64], iterations: usize) -> FittedModel {
        let point = fitted.fit.point.clone();
        let fit = fitted.setup.fit(&fitted.level, scale, &[point], limits(iterations));
        FittedModel { fit, ..fitted.clone() }
    }

    /// Fits `base` plus several candidates, the parameters as they are: from the values of all together, by each of these
    /// `factors` (how much of the strengths, how much of the shift of the parameters that goes with them).
    pub(crate) fn extend_by(
        &self,
        base: &FittedModel,
        open: &[Candidate],
        together: &Together,
        factors: &[(f64, f64)],
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let n0 = self.nominal.model.parameters.len();
        let old = &base.fit.point;
        let mut parts = self.laws(base);
        let mut fresh: Vec<Vec<f64>> = vec![Vec::new(); base.setup.data.pieces.len()];
        let along = LazyCell::new(|| TrajectoryEval::smoothed(base.at(scale)));
        for member in &together.members {
            let candidate = &open[member.candidate];
            let mechanism = &self.library[candidate.mechanism];
            parts.push((candidate.clone(), member.values.clone(), member.scales.clone()));
            if !mechanism.states.is_empty() {
                let own = first_states(&base.setup, mechanism, candidate, &along)?;
                fresh.iter_mut().zip(own).for_each(|(f, o)| f.extend(o));
            }
        }
        let (setup, parts) =
            self.assemble(&base.setup.holds, &old.parameters[..n0], &parts, &base.setup).ok()?;
        let level = same_level(&setup, &base.level);
        let starts = transfer(&base.setup, &base.level, &old.starts, &setup, &fresh);
        let point = |&(values, shift): &(f64, f64)| {
            let mut parameters = old.parameters.clone();
            for (f, d) in base.setup.free.iter().zip(&together.shift) {
                parameters[f.index] = (parameters[f.index] + shift * d).clamp(f.lower, f.upper);
            }
            for member in &together.members {
                let vanish = self.library[open[member.candidate].mechanism].vanish_with_force();
                let value = |(v, vanishes): (&f64, bool)| if vanishes { values * v } else { *v };
                parameters.extend(member.values.iter().zip(vanish).map(value));
            }
            Point { parameters, starts: starts.clone() }
        };
        let points: Vec<Point> = factors.iter().map(point).collect();
        let fit = setup.fit(&level, scale, &points, limits(iterations));
        let fitted = FittedModel { setup, parts, level, fit };
        (fitted.fit.cost.is_finite() && self.admissible(&fitted, scale)).then_some(fitted)
    }

    /// Fits `base` plus two candidates, from the values that they have together.
    pub(super) fn extend_by_pair(
        &self,
        base: &FittedModel,
        open: &[Candidate],
        pair: &Together,
        scale: &[f64],
    ) -> Option<FittedModel> {
        self.extend_by(base, open, pair, &[(1.0, 0.0)], scale, 20)
    }

    /// Complexity of all mechanisms of a model.
    pub(super) fn complexity(&self, fitted: &FittedModel) -> f64 {
        fitted.parts.iter().map(|p| self.library[p.candidate.mechanism].complexity()).sum()
    }

    /// Whether every mechanism's requirements on its parameters hold, and no inertia is negative.
    pub(crate) fn admissible(&self, fitted: &FittedModel, scale: &[f64]) -> bool {
        self.is_admissible(&fitted.parts, fitted.at(scale))
    }

    /// The same of parts in a model at a point of a level.
    pub(crate) fn is_admissible(&self, parts: &[MechanismTerm], at: FitPoint<'_>) -> bool {
        let FitPoint { setup, point, .. } = at;
        parts.iter().all(|part| self.allows(part, setup, &point.parameters)) && !self.has_negative_inertia(at)
    }

    /// Whether a mechanism's requirements on its parameters hold at these values of the model's.
    pub(crate) fn allows(&self, part: &MechanismTerm, setup: &Setup, parameters: &[f64]) -> bool {
        let mechanism = &self.library[part.candidate.mechanism];
        let value = |n: &str| {
            let i = mechanism.parameters().position(|p| p == n)?;
            Some(parameters[setup.model.parameter(&part.instance.names[i])?])
        };
        let required = mechanism.require.iter().all(|e| e.eval(&|n, _| value(n)).is_none_or(|v| v >= 0.0));
        required && (!is_drift(mechanism) || self.keeps_its_sign(mechanism, &value))
    }

    /// Whether a parameter that drifts, with these values of the drift's own, has one sign until the end of the recordings.
    fn keeps_its_sign(&self, mechanism: &Mechanism, value: &dyn Fn(&str) -> Option<f64>) -> bool {
        let end = self.nominal.data.pieces.iter().map(|p| p.start + p.len as f64 * p.dt).fold(0.0, f64::max);
        let at = |t: f64| {
            mechanism.law.eval(&|n, _| match n {
                "p" => Some(1.0),
                "t" => Some(t),
                _ => value(n),
            })
        };
        match (at(0.0), at(end)) {
            (Some(first), Some(last)) => first * last > 0.0,
            _ => true,
        }
    }

    /// Fits `base` plus one candidate.
    pub(super) fn extend(
        &self,
        base: &FittedModel,
        candidate: &Candidate,
        scored: &Scored,
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let n0 = self.nominal.model.parameters.len();
        let mut parts = self.laws(base);
        parts.push((candidate.clone(), scored.values.clone(), scored.scales.clone()));
        let old = &base.fit.point;
        let (mut setup, parts) =
            self.assemble(&base.setup.holds, &old.parameters[..n0], &parts, &base.setup).ok()?;
        let plain: Vec<f64> = old.parameters.iter().chain(&scored.values).copied().collect();
        let mut shifted = plain.clone();
        for (f, d) in base.setup.free.iter().zip(&scored.shift) {
            shifted[f.index] = (shifted[f.index] + d).clamp(f.lower, f.upper);
        }
        for (p, v) in setup.model.parameters.iter_mut().zip(&shifted) {
            p.value = *v;
        }
        let mechanism = &self.library[candidate.mechanism];
        let fresh = if mechanism.states.is_empty() {
            Vec::new()
        } else {
            let along = TrajectoryEval::smoothed(base.at(scale));
            first_states(&base.setup, mechanism, candidate, &along)?
        };
        let level = same_level(&setup, &base.level);
        let kept = transfer(&base.setup, &base.level, &old.starts, &setup, &fresh);
        if !mechanism.states.is_empty() {
            // What it brings along may be faster than the machine.
            let tolerance: Vec<f64> = scale.iter().map(|s| 0.05 * s).collect();
            setup.choose_method(&tolerance, longest(&level));
        }
        let mut starts = setup.starts(&level, &shifted);
        // What the mechanism remembers has its own likely start.
        for (h, k) in starts.iter_mut().zip(&kept) {
            for (j, state) in setup.model.states.iter().enumerate() {
                if base.setup.model.state(&state.name).is_none() {
                    let at = setup.system.offsets[j]..setup.system.offsets[j] + state.order;
                    h[at.clone()].copy_from_slice(&k[at]);
                }
            }
        }
        let mut points = vec![
            Point { parameters: shifted.clone(), starts: kept.clone() },
            Point { parameters: plain, starts: kept.clone() },
            Point { parameters: shifted, starts },
        ];
        // Less of it, and other choices of the inner parameters: the score test is only of first order.
        if let Some(reduced_start) = &scored.reduced_start {
            let parameters = old.parameters.iter().chain(reduced_start).copied().collect();
            points.push(Point { parameters, starts: kept.clone() });
        }
        for (_, values, shift) in &scored.others {
            let mut parameters: Vec<f64> = old.parameters.iter().chain(values).copied().collect();
            for (f, d) in base.setup.free.iter().zip(shift) {
                parameters[f.index] = (parameters[f.index] + d).clamp(f.lower, f.upper);
            }
            points.push(Point { parameters, starts: kept.clone() });
        }
        // With a memory of its own, where a fit starts decides where it ends: a few steps from the best few.
        if !mechanism.states.is_empty() {
            points = setup.best_points(&level, scale, points, STARTING_POINTS);
            if points.len() > 1 {
                points = points
                    .into_iter()
                    .map(|p| setup.fit(&level, scale, &[p], limits(STEPS_TO_TELL)).point)
                    .collect();
            }
        }
        let fit = setup.fit(&level, scale, &points, limits(iterations));
        fit.cost.is_finite().then(|| FittedModel { setup, parts, level, fit })
    }

    /// `fitted` without part `index`, refitted.
    pub(super) fn without(
        &self,
        fitted: &FittedModel,
        index: usize,
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let mut parts = self.laws(fitted);
        parts.remove(index);
        self.reassembled(fitted, &parts, scale, iterations)
    }

    /// The model with other parts at these values, from a fit's parameters.
    pub(super) fn reassembled(
        &self,
        fitted: &FittedModel,
        parts: &[Law],
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        self.reassembled_from(fitted, parts, Vec::new(), scale, iterations)
    }

    /// [`reassembled`](Self::reassembled) from there or from one of the `others`, values of all parameters.
    pub(crate) fn reassembled_from(
        &self,
        fitted: &FittedModel,
        parts: &[Law],
        others: Vec<Vec<f64>>,
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let n0 = self.nominal.model.parameters.len();
        let head = &fitted.fit.point.parameters[..n0];
        let (setup, kept) = self.assemble(&fitted.setup.holds, head, parts, &fitted.setup).ok()?;
        let mut own = head.to_vec();
        own.extend(parts.iter().flat_map(|p| p.1.iter().copied()));
        let level = same_level(&setup, &fitted.level);
        let starts = transfer(&fitted.setup, &level, &fitted.fit.point.starts, &setup, &[]);
        let points: Vec<Point> = std::iter::once(own)
            .chain(others)
            .map(|parameters| Point { parameters, starts: starts.clone() })
            .collect();
        let fit = setup.fit(&level, scale, &points, limits(iterations));
        Some(FittedModel { setup, parts: kept, level, fit })
    }

    /// Tries the other holds of every input; switches where the cost falls by more than `margin`.
    pub(crate) fn redecide_holds(&self, fitted: &FittedModel, scale: &[f64], margin: f64) -> FittedModel {
        let mut best = fitted.clone();
        if self.keep_holds {
            return best;
        }
        let gain = |from: &FittedModel, to: &FittedModel| -> f64 {
            let ratios = effective_sample_ratio(to.at(scale));
            (0..ratios.len())
                .filter(|&c| to.fit.rss[c] > 0.0 && from.fit.rss[c] > 0.0)
                .map(|c| to.fit.count[c] as f64 * ratios[c] * (from.fit.rss[c] / to.fit.rss[c]).ln())
                .sum()
        };
        // What the model states counts unless the data speak clearly: another hold may have stood in for a
        // delay that has its own name now.
        for i in 0..fitted.setup.holds.len() {
            let stated = self.nominal.holds[i];
            if best.setup.holds[i] != stated {
                let mut holds = best.setup.holds.clone();
                holds[i] = stated;
                let trial = FittedModel { setup: best.setup.with_holds(holds), ..best.clone() };
                let trial = self.refit(&trial, scale, 10);
                if gain(&trial, &best) < HOLD_GAIN {
                    best = trial;
                }
            }
        }
        for i in 0..fitted.setup.holds.len() {
            if self.nominal.model.inputs[i].derivative_of().is_some() || !fitted.setup.data.input_moves(i) {
                continue;
            }
            for hold in [Hold::Zero, Hold::Linear, Hold::BandLimited] {
                if hold == best.setup.holds[i] {
                    continue;
                }
                let mut holds = best.setup.holds.clone();
                holds[i] = hold;
                let trial = FittedModel { setup: best.setup.with_holds(holds), ..best.clone() };
                let trial = self.refit(&trial, scale, 4);
                if trial.fit.cost < best.fit.cost * (1.0 - margin) {
                    // Significant for the information that a correlated residual holds, or else the
                    // hold would follow the misfit of a model that lacks something.
                    if gain(&best, &trial) > HOLD_GAIN {
                        best = trial;
                    }
                }
            }
        }
        best
    }

    /// The model without part `index`, on the same segments, refitted.
    pub fn smaller(&self, fitted: &FittedModel, index: usize, scale: &[f64]) -> Option<FittedModel> {
        self.without(fitted, index, scale, STEPS_WITHOUT)
    }

    /// How well the recordings determine each part: the largest of its strengths over the half `widths` of their 95 %
    /// intervals (of the free parameters). −∞ for a part without strengths of its own, which shows nothing of the kind.
    pub(crate) fn known(&self, fitted: &FittedModel, widths: &[f64]) -> Vec<f64> {
        let known = |part: &MechanismTerm| -> f64 {
            let mechanism = &self.library[part.candidate.mechanism];
            let ratio = |name: &String| {
                let index = fitted.setup.model.parameter(name)?;
                let at = fitted.setup.free.iter().position(|f| f.index == index)?;
                let value = fitted.fit.point.parameters[index].abs();
                let ratio = value / widths[at];
                Some(if ratio.is_nan() || value == 0.0 { 0.0 } else { ratio })
            };
            let names = part.instance.names.iter().zip(mechanism.vanish_with_force());
            let known = names.filter(|(_, vanishes)| *vanishes).filter_map(|(name, _)| ratio(name));
            known.fold(f64::NEG_INFINITY, f64::max)
        };
        fitted.parts.iter().map(known).collect()
    }

    /// The part whose strengths the recordings determine least, where the 95 % intervals (half `widths`, of the free
    /// parameters) of all of them hold zero: such a mechanism may as well not be there.
    pub fn undetermined(&self, fitted: &FittedModel, widths: &[f64]) -> Option<usize> {
        let ratios =
            self.known(fitted, widths).into_iter().enumerate().filter(|(_, r)| *r != f64::NEG_INFINITY);
        let least = ratios.filter(|(_, ratio)| *ratio < 1.0).min_by(|a, b| a.1.total_cmp(&b.1));
        least.map(|(index, _)| index)
    }

    /// The parts that act at certain times of a single recording. Nothing tells when they would act in another.
    pub fn bound_to_a_clock(&self, fitted: &FittedModel) -> Vec<usize> {
        (0..fitted.parts.len()).filter(|i| self.is_bound_to_a_clock(&fitted.parts[*i].candidate)).collect()
    }

    /// Whether a candidate acts at certain times of a single recording.
    pub(crate) fn is_bound_to_a_clock(&self, candidate: &Candidate) -> bool {
        self.nominal.data.recordings.len() == 1 && is_timed(&self.library[candidate.mechanism])
    }

    /// Whether the mechanisms turn the sign of the mass matrix's determinant somewhere along the recordings: a negative
    /// inertia, or a coupling of accelerations stronger than the inertias that it couples.
    pub fn has_negative_inertia(&self, at: FitPoint<'_>) -> bool {
        let FitPoint { setup, .. } = at;
        let along = TrajectoryEval::smoothed(at);
        let n0 = self.nominal.system.nz;
        let model = &setup.model;
        let highest: Vec<(&str, u8)> =
            self.nominal.model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let mass = |model: &Model| -> Option<Vec<greybox_model::Expr>> {
            let rows = model.equations.iter().take(n0).map(|e| Some(e.residual().affine_in(&highest)?.0));
            Some(rows.collect::<Option<Vec<_>>>()?.concat())
        };
        let (Some(before), Some(after)) = (mass(&self.nominal.model), mass(model)) else { return false };
        if before == after {
            return false;
        }
        let values = |exprs: &[greybox_model::Expr]| along.eval(exprs, &[]);
        let (Some(before), Some(after)) = (values(&before), values(&after)) else { return false };
        let sign = |values: &[Vec<Vec<f64>>], piece: usize, k: usize| {
            let mut a: Vec<f64> = values.iter().map(|e| e[piece][k]).collect();
            determinant_sign(&mut a, n0)
        };
        let pieces = self.nominal.data.lengths();
        pieces
            .iter()
            .enumerate()
            .any(|(p, &n)| (0..n).any(|k| sign(&before, p, k) * sign(&after, p, k) < 0.0))
    }

    /// Whether the 95 % interval of one of a part's strengths is wider than the largest of them.
    pub(super) fn is_undetermined(&self, fitted: &FittedModel, part: usize, scale: &[f64]) -> bool {
        let strengths = self.strengths(fitted, part, scale);
        let largest = strengths.iter().map(|s| s.value.abs()).fold(0.0, f64::max);
        strengths.iter().any(|s| s.width > largest)
    }

    /// The linear parameters of a part that are fitted; none of a part that is not there.
    pub(super) fn strengths(&self, fitted: &FittedModel, part: usize, scale: &[f64]) -> Vec<Strength> {
        let Some(part) = fitted.parts.get(part) else { return Vec::new() };
        let mechanism = &self.library[part.candidate.mechanism];
        let widths = Uncertainty::of(fitted, scale).widths();
        mechanism
            .parameters()
            .zip(&part.instance.names)
            .filter(|(plain, _)| mechanism.linear.iter().any(|l| l == plain))
            .filter_map(|(plain, name)| {
                let index = fitted.setup.model.parameter(name)?;
                let at = fitted.setup.free.iter().position(|f| f.index == index)?;
                let least =
                    if mechanism.positive.iter().any(|p| p == plain) { 0.0 } else { f64::NEG_INFINITY };
                Some(Strength { index, value: fitted.fit.point.parameters[index], width: widths[at], least })
            })
            .collect()
    }

    /// The model with these parts, of which one has its inner parameters held where they are.
    pub(super) fn held(
        &self,
        fitted: &FittedModel,
        parts: &[Law],
        index: usize,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let mut held = self.reassembled(fitted, parts, scale, 0)?;
        let mechanism = &self.library[held.parts[index].candidate.mechanism];
        let names = mechanism.parameters().zip(&held.parts[index].instance.names);
        let inner: Vec<usize> = names
            .filter(|(plain, _)| !mechanism.linear.iter().any(|l| l == plain))
            .filter_map(|(_, name)| held.setup.model.parameter(name))
            .collect();
        held.setup.free.retain(|f| !inner.contains(&f.index));
        Some(self.refit(&held, scale, STEPS_TO_TELL))
    }
}

/// A state of another model: entries of the same name keep what they are (`unknown` where that is not given), new ones are
/// `fresh` (their chains in order; zero where there is none).
pub(crate) fn carried(from: &Setup, old: &[f64], to: &Setup, fresh: &[f64], unknown: f64) -> Vec<f64> {
    let mut x = vec![0.0; to.system.nx];
    let mut new = fresh.iter();
    for (j, state) in to.model.states.iter().enumerate() {
        let known = from.model.state(&state.name).map(|i| from.system.offsets[i]);
        for k in 0..state.order {
            x[to.system.offsets[j] + k] = match known {
                Some(at) => old.get(at + k).copied().unwrap_or(unknown),
                None => new.next().copied().unwrap_or(0.0),
            };
        }
    }
    x
}

/// Start values for another model of the same data; new states get those of `fresh`, per piece.
pub(super) fn transfer(
    from: &Setup,
    level: &Segmentation,
    starts: &[Vec<f64>],
    to: &Setup,
    fresh: &[Vec<f64>],
) -> Vec<Vec<f64>> {
    let fresh = |piece: usize| fresh.get(piece).map_or(&[][..], Vec::as_slice);
    let segments = level.segments.iter().zip(starts);
    segments.map(|(segment, old)| carried(from, old, to, fresh(segment.piece), 0.0)).collect()
}

/// Whether a law depends on the time since a recording began.
fn is_timed(mechanism: &Mechanism) -> bool {
    mechanism.law.mentions("t")
}

/// Whether a mechanism lets a parameter change with time.
pub(super) fn is_drift(mechanism: &Mechanism) -> bool {
    mechanism.on == crate::library::On::Parameter && is_timed(mechanism)
}

/// A fitted linear parameter of a mechanism.
pub(super) struct Strength {
    /// Index in the model.
    pub(super) index: usize,
    pub(super) value: f64,
    /// Half of the 95 % interval.
    pub(super) width: f64,
    /// Least admissible value.
    pub(super) least: f64,
}

/// The sign of the determinant of an n × n matrix, by rows, which it overwrites.
fn determinant_sign(a: &mut [f64], n: usize) -> f64 {
    let mut pivots = vec![0; n];
    if !greybox_simulate::small::factor(a, &mut pivots, n) {
        return 0.0;
    }
    let swaps = pivots.iter().enumerate().filter(|(i, p)| i != *p).count();
    let product: f64 = (0..n).map(|i| a[i * n + i].signum()).product();
    if swaps % 2 == 0 { product } else { -product }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sign_of_a_determinant_follows_its_rows() {
        let sign = |rows: [f64; 9]| determinant_sign(&mut rows.to_vec(), 3);
        assert_eq!(sign([2.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 4.0]), 1.0);
        assert_eq!(sign([0.0, 3.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 4.0]), -1.0, "two rows changed");
        assert_eq!(sign([0.0, 0.0, 4.0, 2.0, 0.0, 0.0, 0.0, 3.0, 0.0]), 1.0, "all three changed round");
        assert_eq!(sign([1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]), -1.0, "1 − 4");
        assert_eq!(sign([1.0, 2.0, 0.0, 2.0, 4.0, 0.0, 0.0, 0.0, 1.0]), 0.0, "singular");
    }
}
