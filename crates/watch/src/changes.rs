//! What a watch knows, as events in the units of the model file.

use greybox_model::Unit;
use greybox_recursive::Direction;

use crate::blocks::Ended;
use crate::event::{Change, Estimates, Learned, Outside, Parameter, Subject};
use crate::learn::Place;
use crate::naming::{Explanation, alternatives, dispersion, likeliest};
use crate::saved::Known;
use crate::watch::Watch;

impl Watch {
    fn subject(&self, effect: usize) -> Subject {
        let (model, free, nz) = (&self.machine.model, &self.now.usual.free, self.machine.system.nz);
        match effect.checked_sub(free.len()) {
            None => Subject::Parameter(free[effect].name.clone()),
            Some(j) if j < nz => Subject::Force(model.states[j].name.clone()),
            Some(j) => Subject::Offset(model.measurements[j - nz].channel.clone()),
        }
    }

    /// The best explanation as a change from a place.
    pub(crate) fn effect_change(&self, ended: &Ended, explanations: &[Explanation], from: &Place) -> Change {
        let (model, free, nz) = (&self.machine.model, &self.now.usual.free, self.machine.system.nz);
        let best = explanations[0];
        let (before, unit) = match best.effect.checked_sub(free.len()) {
            None => {
                let index = free[best.effect].index;
                (from.values[index], model.parameters[index].unit.clone())
            }
            Some(j) if j < nz => (from.forces[j], None),
            Some(j) => (from.offsets[j - nz], Some(model.measurements[j - nz].unit.of_difference())),
        };
        Change {
            t: ended.t,
            subject: self.subject(best.effect),
            or: alternatives(explanations, self.now.inflation).map(|e| self.subject(e)).collect(),
            direction: if best.step > 0.0 { Direction::Up } else { Direction::Down },
            since: ended.t - best.blocks as f64 * self.now.block_seconds,
            before: reported(unit.as_ref(), before),
            now: reported(unit.as_ref(), before + best.step),
            std: difference(unit.as_ref(), best.std * dispersion(&best, self.now.inflation).sqrt()),
            unit: unit.map(|u| u.text),
        }
    }

    /// The parameter that the followed model has moved the most, in its standard deviations, and those beside it whose
    /// likelihood is a twentieth of its or more.
    pub(crate) fn parameter_change(&self, ended: &Ended, known: &Known, from: &Place) -> Change {
        let (now, Known { values, deviations, .. }) = (&self.now, known);
        let moved = |k: usize| {
            let index = now.usual.free[k].index;
            values[index] - from.values[index]
        };
        let gains: Vec<f64> = (0..deviations.len()).map(|k| (moved(k) / deviations[k]).powi(2)).collect();
        let (most, alternatives) = likeliest(&gains);
        let index = now.usual.free[most].index;
        let unit = self.machine.model.parameters[index].unit.as_ref();
        Change {
            t: ended.t,
            subject: self.subject(most),
            or: alternatives.into_iter().map(|k| self.subject(k)).collect(),
            direction: if moved(most) > 0.0 { Direction::Up } else { Direction::Down },
            since: ended.t,
            before: reported(unit, from.values[index]),
            now: reported(unit, values[index]),
            std: difference(unit, deviations[most]),
            unit: unit.map(|u| u.text.clone()),
        }
    }

    /// A channel that scatters by a factor of what it did.
    pub(crate) fn scatter_change(&self, ended: &Ended, since: f64, channel: usize, ratio: f64) -> Change {
        Change {
            t: ended.t,
            subject: Subject::Noise(self.machine.model.measurements[channel].channel.clone()),
            or: Vec::new(),
            direction: if ratio > 1.0 { Direction::Up } else { Direction::Down },
            since,
            before: 1.0,
            now: ratio,
            std: 0.0,
            unit: None,
        }
    }

    fn parameters(&self, deviations: &[f64]) -> Vec<Parameter> {
        let free = self.now.usual.free.iter().zip(deviations);
        free.map(|(f, std)| {
            let unit = self.machine.model.parameters[f.index].unit.as_ref();
            Parameter {
                name: f.name.clone(),
                value: reported(unit, self.now.values[f.index]),
                std: difference(unit, *std),
                unit: unit.map(|u| u.text.clone()),
            }
        })
        .collect()
    }

    pub(crate) fn learned(&self) -> Learned {
        Learned {
            t: self.now.last.t,
            rate: 1.0 / self.now.usual.dt,
            block: self.now.block_seconds,
            alarms_per_day: self.now.alarms_per_day,
            charts: self.now.charts.len(),
            parameters: self.parameters(&self.now.fit.deviations()),
            undetermined: self.undetermined(),
        }
    }

    /// Parameters of which the learned seconds hold less information than what was known beforehand: their variance is still more
    /// than half of the prior's.
    fn undetermined(&self) -> Vec<String> {
        let (free, covered) = (&self.now.usual.free, &self.now.covered);
        let n = free.len();
        let told = |k: usize| covered[k * n + k] <= 0.5 * free[k].std.powi(2);
        (0..n).filter(|k| !told(*k)).map(|k| free[k].name.clone()).collect()
    }

    /// What a block says more of than all that was learned. A score is judged by the parameters that were learned; where what is not
    /// known of them makes it scatter more than the noise does, nothing is known of how it is distributed. Of the blocks that were
    /// learned none is such a one ([`Block::leverages`](crate::blocks::Block::leverages)): P⁻¹ is the sum of their information.
    pub(crate) fn outside(&self, ended: &Ended) -> Option<Outside> {
        let (free, covered) = (&self.now.usual.free, &self.now.covered);
        if ended.block.leverages(covered).iter().all(|leverage| *leverage <= 1.0) {
            return None;
        }
        let n = free.len();
        let shares = (0..n).map(|k| ended.scores.information[k] * covered[k * n + k]);
        let mut shares: Vec<(usize, f64)> = shares.enumerate().collect();
        shares.sort_by(|a, b| b.1.total_cmp(&a.1));
        let named = shares.iter().enumerate().filter(|(place, (_, share))| *place == 0 || *share > 1.0);
        Some(Outside { t: ended.t, parameters: named.map(|(_, (k, _))| free[*k].name.clone()).collect() })
    }

    pub(crate) fn estimates(&self, ended: &Ended) -> Estimates {
        let (model, free) = (&self.machine.model, &self.now.usual.free);
        let n = free.len();
        let mut covariance = self.now.fit.covariance();
        let deviations: Vec<f64> = (0..n).map(|k| covariance[k * n + k].sqrt()).collect();
        let unit = |k: usize| model.parameters[free[k].index].unit.as_ref();
        for a in 0..n {
            for b in 0..n {
                let value = &mut covariance[a * n + b];
                *value = difference(unit(a), difference(unit(b), *value));
            }
        }
        let missing = model.states.iter().enumerate().map(|(j, state)| {
            let (value, std) = ended.scores.change(n + j);
            let std = std * self.now.inflation.sqrt();
            let value = value + self.now.usual.place.forces[j];
            Parameter { name: state.name.clone(), value, std, unit: None }
        });
        Estimates {
            t: ended.t,
            parameters: self.parameters(&deviations),
            covariance,
            missing: missing.collect(),
            innovations: model
                .measurements
                .iter()
                .zip(ended.block.rms())
                .map(|(m, rms)| (m.channel.clone(), rms))
                .collect(),
        }
    }
}

/// A value in its unit.
fn reported(unit: Option<&Unit>, si: f64) -> f64 {
    unit.map_or(si, |u| u.from_si(si))
}

/// A difference in its unit.
fn difference(unit: Option<&Unit>, si: f64) -> f64 {
    unit.map_or(si, |u| u.difference_from_si(si))
}
