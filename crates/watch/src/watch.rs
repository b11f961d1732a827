//! The watch: two filters, one that keeps to what is usual and one that follows the machine, and the charts.

use greybox_model::{Model, System, Unit};
use greybox_recording::Recording;
use greybox_recursive::{Chart, Direction, LeastSquares};
use serde::{Deserialize, Serialize};

use crate::blocks::{Block, Scores, together};
use crate::error::WatchError;
use crate::event::{Change, Clock, Estimates, Event, Irregular, Learned, Parameter, Subject};
use crate::learn::{First, Sample, Usual, learn};
use crate::machine::Machine;
use crate::naming::{Explanation, alternatives, dispersion, explanations, likeliest};
use crate::options::{BLOCK_SAMPLES, BLOCKS, Options};
use crate::tracker::{Conditions, Effects, Tracker};

/// The change that a chart is quickest for, in standard deviations of one block.
const CHANGE: f64 = 1.0;
/// Fewest blocks that the learned seconds are left with.
const FEWEST: usize = 12;
/// Blocks that are remembered to tell how large a change is.
const REMEMBERED: usize = 512;
/// Share of the memory after which a change is known so well that its linearisation is good.
const COARSE: f64 = 0.1;
/// Most blocks that irregularities wait until they are told.
const MOST_WAIT: u32 = 256;

/// A machine that is watched.
///
/// ```text
/// usual model:      ν, ψ of every sample  →  per block and single change δᵢ:  zᵢ = Σ ψᵢν / √(Σ ψᵢ²)  →  chart
/// followed model:   recursive least squares of ν on ψ with forgetting  →  parameters with covariance
/// ```
///
/// zᵢ is the score of the change i alone (M. Basseville, I. Nikiforov, *Detection of Abrupt Changes*, 1993, ch. 8: the local
/// approach). What a wrong model leaves in the scores at all times is part of what the charts, which compare ranks, take as usual.
/// Where a chart exceeds its limit, the change is named that explains the blocks since its onset best; after one memory,
/// the parameter that the followed model has moved most.
#[derive(Debug, Clone)]
pub struct Watch {
    machine: Machine,
    now: Saved,
}

/// The state of a watch as data: what [`Watch::restore`] goes on from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Saved {
    version: u32,
    alarms_per_day: f64,
    memory: f64,
    /// Seconds of a block.
    block_seconds: f64,
    usual: Usual,
    /// Mean and standard deviation of the state while it learned: where it begins anew.
    rest: (Vec<f64>, Vec<f64>),
    /// Variance of the scores over that of white innovations.
    inflation: f64,
    keeping: Tracker,
    following: Tracker,
    fit: LeastSquares,
    /// Parameters of the followed model, SI.
    values: Vec<f64>,
    charts: Vec<Chart>,
    block: Block,
    began: f64,
    history: Vec<Scores>,
    last: Sample,
    settling: Option<Settling>,
    irregular: Irregular,
    /// Blocks that irregularities wait until they are told, and the next wait: it doubles while they go on.
    wait: (u32, u32),
}

/// A change that settles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Settling {
    until: f64,
    /// When the fit begins once more, at parameters that are near by then: rows from before are of another linearisation.
    again: Option<f64>,
    /// The channel whose scatter it is; else a parameter, a force or an offset.
    noise: Option<usize>,
    since: f64,
    /// Means of all charts before.
    means: Vec<f64>,
}

/// Version of [`Saved`].
const VERSION: u32 = 1;

impl Watch {
    /// Learns from the first seconds of a machine what is usual: parameters, noise, model error.
    ///
    /// # Errors
    /// [`WatchError`] where options make no sense, the recording does not have what the model needs or is too short, or the
    /// model cannot follow it.
    pub fn learn(model: &Model, first: &Recording, options: &Options) -> Result<(Watch, Event), WatchError> {
        options.check()?;
        let first = learn(model, first, options)?;
        let FirstPass { block_seconds, rest, inflation } = first_pass(&first, options)?;
        let First { machine, usual, start, samples } = first;
        let (state, deviation) = (&start.0[..], &start.1[..]);
        let keeping = Tracker::new(&machine, (state, deviation), Effects::Everything)?;
        let following = Tracker::new(&machine, (state, deviation), Effects::Parameters)?;
        let (mean, std): (Vec<f64>, Vec<f64>) =
            usual.free.iter().map(|f| (usual.values[f.index], f.std)).unzip();
        let effects = keeping.count(&machine);
        let charts = effects + machine.system.ny;
        let chart = Chart::new(CHANGE, charts as f64 * 86_400.0 / block_seconds / options.alarms_per_day)?;
        let last = samples[0].clone();
        let now = Saved {
            version: VERSION,
            alarms_per_day: options.alarms_per_day,
            memory: options.memory,
            block_seconds,
            values: usual.values.clone(),
            fit: LeastSquares::new(&mean, &std)?,
            usual,
            rest,
            inflation,
            keeping,
            following,
            charts: vec![chart; charts],
            block: Block::new(effects, machine.system.ny),
            began: last.t,
            history: Vec::new(),
            last,
            settling: None,
            irregular: Irregular::default(),
            wait: (0, 1),
        };
        let mut watch = Watch { machine, now };
        for sample in samples.into_iter().skip(1) {
            if sample.t - watch.now.last.t > block_seconds {
                watch.begin_anew(sample);
            } else if let Some(ended) = watch.advance(sample) {
                // (What a chart takes for a change here is still part of what is usual.)
                let values = ended.values();
                watch.now.charts.iter_mut().zip(values).for_each(|(chart, v)| {
                    if chart.push(v).is_some() {
                        chart.restart();
                    }
                });
            }
        }
        watch.now.irregular = Irregular::default();
        let learned = watch.learned();
        Ok((watch, Event::Learned(learned)))
    }

    /// Goes on from a saved state.
    ///
    /// # Errors
    /// [`WatchError::OtherModel`] where the state is another model's; [`WatchError::Setup`] where the model does not compile.
    pub fn restore(model: &Model, saved: Saved) -> Result<Watch, WatchError> {
        let other = |what: String| Err(WatchError::OtherModel { what });
        if saved.version != VERSION {
            return other(format!("it has version {}, and this is version {VERSION}", saved.version));
        }
        let system = System::compile(model).map_err(greybox_calibrate::SetupError::from)?;
        if saved.usual.values.len() != system.np || saved.usual.noise.len() != system.ny {
            return other("it has other parameters or channels".to_owned());
        }
        if saved.last.inputs.len() != system.nu || saved.rest.0.len() != system.nx {
            return other("it has other inputs or states".to_owned());
        }
        if let Some(f) = saved.usual.free.iter().find(|f| model.parameter(&f.name) != Some(f.index)) {
            return other(format!("the model has no parameter `{}` in that place", f.name));
        }
        if !saved.is_consistent(&system) {
            return other("its parts do not fit together".to_owned());
        }
        let free = saved.usual.free.iter().map(|f| f.index).collect();
        let machine = Machine::new(model.clone(), system.into(), saved.usual.steps.method(), free);
        Ok(Watch { machine, now: saved })
    }

    /// The state, to be saved.
    pub fn saved(&self) -> &Saved {
        &self.now
    }

    /// Takes the next sample: its time, inputs and measured values in SI and in the model's order, NaN for what is missing.
    pub fn push(&mut self, t: f64, inputs: &[f64], measured: &[f64]) -> Vec<Event> {
        let mut events = Vec::new();
        let (last, dt) = (self.now.last.t, self.now.usual.dt);
        // (A time that is no number is none.)
        if !t.is_finite() || t <= last && t > last - self.now.block_seconds {
            let repeated = (t - last).abs() < 1e-6 * dt;
            let count =
                if repeated { &mut self.now.irregular.repeated } else { &mut self.now.irregular.late };
            *count += 1;
            return events;
        }
        let mut sample = Sample {
            t,
            inputs: inputs.to_vec(),
            measured: measured.iter().map(|v| Some(*v).filter(|v| v.is_finite())).collect(),
        };
        sample.inputs.resize(self.machine.system.nu, f64::NAN);
        sample.measured.resize(self.machine.system.ny, None);
        self.now.irregular.not_measured += sample.measured.iter().filter(|v| v.is_none()).count() as u64;
        for (new, old) in sample.inputs.iter_mut().zip(&self.now.last.inputs) {
            if !new.is_finite() {
                *new = *old;
                self.now.irregular.input_held += 1;
            }
        }
        if t <= last || t - last > self.now.block_seconds {
            events.push(Event::Restarted(Clock { from: last, t }));
            self.begin_anew(sample);
            return events;
        }
        self.now.irregular.missing += (((t - last) / dt).round() as u64).saturating_sub(1);
        if let Some(ended) = self.advance(sample) {
            self.judge(&ended, &mut events);
        }
        events
    }

    /// The state begins anew where nothing is known of it but what it was on the average.
    fn begin_anew(&mut self, sample: Sample) {
        let now = &mut self.now;
        for tracker in [&mut now.keeping, &mut now.following] {
            tracker.restart((&now.rest.0, &now.rest.1));
        }
        now.block.clear();
        (now.began, now.last) = (sample.t, sample);
    }

    /// Takes a sample; a block that has ended.
    fn advance(&mut self, sample: Sample) -> Option<Ended> {
        let now = &mut self.now;
        let block = &mut now.block;
        let usual = Conditions {
            machine: &self.machine,
            usual: &now.usual,
            values: &now.usual.values,
            memory: now.memory,
        };
        let kept = now.keeping.advance(&usual, &now.last, &sample, |c, i| block.push(c, &i));
        let free = &now.usual.free;
        let at: Vec<f64> = free.iter().map(|f| now.values[f.index]).collect();
        let followed = Conditions { values: &now.values, ..usual };
        let fit = &mut now.fit;
        fit.forget((-(sample.t - now.last.t) / now.memory).exp());
        let weight = 1.0 / now.inflation.sqrt();
        let mut row = vec![0.0; at.len()];
        let kept_up = now.following.advance(&followed, &now.last, &sample, |_, i| {
            row.iter_mut().zip(i.row).for_each(|(r, psi)| *r = weight * psi);
            let here: f64 = row.iter().zip(&at).map(|(r, a)| r * a).sum();
            fit.update(&row, weight * i.value + here);
        });
        if !kept || !kept_up {
            now.irregular.diverged += 1;
            if !kept_up {
                // Parameters with which the model cannot be simulated are none to go on from.
                now.values.clone_from(&now.usual.values);
                now.fit.restart();
            }
            self.begin_anew(sample);
            return None;
        }
        let estimate = fit.estimate();
        let mut change = vec![0.0; at.len()];
        for (k, f) in free.iter().enumerate() {
            // A bound is never reached, only half of the way to it.
            let to = match (f.lower, f.upper) {
                (Some(low), _) if estimate[k] <= low => 0.5 * (at[k] + low),
                (_, Some(high)) if estimate[k] >= high => 0.5 * (at[k] + high),
                _ => estimate[k],
            };
            change[k] = to - at[k];
            now.values[f.index] = to;
        }
        now.following.filter.follow(&change);
        let t = sample.t;
        now.last = sample;
        if t - now.began < now.block_seconds - 0.5 * now.usual.dt {
            return None;
        }
        now.began = t;
        let empty = Block::new(now.keeping.count(&self.machine), self.machine.system.ny);
        let block = std::mem::replace(&mut now.block, empty);
        let scores = block.scores();
        now.history.push(scores.clone());
        if now.history.len() > REMEMBERED {
            now.history.remove(0);
        }
        Some(Ended { t, scatter: block.scatter(&scores), scores, block })
    }

    /// What a block has to say.
    fn judge(&mut self, ended: &Ended, events: &mut Vec<Event>) {
        let (wait, next) = self.now.wait;
        self.now.wait = match (wait, self.now.irregular.is_empty()) {
            (0, true) => (0, 1),
            (0, false) => {
                events.push(Event::Irregular(std::mem::take(&mut self.now.irregular)));
                (next, (2 * next).min(MOST_WAIT))
            }
            (wait, _) => (wait - 1, next),
        };
        events.push(Event::Estimates(self.estimates(ended)));
        match self.now.settling.take() {
            Some(change) if ended.t >= change.until => {
                events.push(Event::Settled(self.settle(ended, &change)))
            }
            Some(mut change) => {
                if change.again.take_if(|again| ended.t >= *again).is_some() {
                    self.now.fit.restart();
                }
                self.now.settling = Some(change);
            }
            None => events.extend(self.alarm(ended).map(Event::Changed)),
        }
    }

    /// Puts a block on the charts, and says what has changed where one exceeds its limit.
    fn alarm(&mut self, ended: &Ended) -> Option<Change> {
        let now = &mut self.now;
        let means: Vec<f64> = now.charts.iter().map(Chart::mean).collect();
        let alarms: Vec<_> = now.charts.iter_mut().zip(ended.values()).map(|(c, v)| c.push(v)).collect();
        let alarms = alarms.iter().enumerate().filter_map(|(i, alarm)| alarm.map(|a| (i, a)));
        let (loudest, alarm) = alarms.max_by(|(_, a), (_, b)| a.excess.total_cmp(&b.excess))?;
        let effects = ended.scores.gradient.len();
        let noise = loudest.checked_sub(effects);
        let mut change = Settling {
            until: ended.t + now.memory,
            again: noise.is_none().then_some(ended.t + COARSE * now.memory),
            noise,
            since: ended.t - alarm.since as f64 * now.block_seconds,
            means,
        };
        let told = match noise {
            Some(channel) => self.scatter_told(ended, &change, channel),
            None => {
                let all = explanations(&now.history, &change.means, alarm.since as usize);
                change.since = ended.t - all[0].blocks as f64 * now.block_seconds;
                // What was known of the machine before the change is no longer so.
                now.fit.restart();
                self.told(ended, &all)
            }
        };
        self.now.settling = Some(change);
        Some(told)
    }

    /// From here on what has changed is usual.
    fn settle(&mut self, ended: &Ended, change: &Settling) -> Change {
        let told = match change.noise {
            Some(channel) => self.scatter_told(ended, change, channel),
            None => {
                let blocks = ((ended.t - change.since) / self.now.block_seconds).round() as usize;
                let all = explanations(&self.now.history, &change.means, blocks);
                let np = self.now.usual.free.len();
                if all[0].effect < np { self.followed(ended) } else { self.told(ended, &all) }
            }
        };
        let told = Change { since: change.since, ..told };
        let now = &mut self.now;
        if matches!(told.subject, Subject::Parameter(_)) {
            now.usual.values.clone_from(&now.values);
            now.keeping.filter.take_state(&now.following.filter);
        }
        now.charts.iter_mut().for_each(Chart::restart);
        now.history.clear();
        told
    }

    fn subject(&self, effect: usize) -> Subject {
        let (model, free, nz) = (&self.machine.model, &self.now.usual.free, self.machine.system.nz);
        match effect.checked_sub(free.len()) {
            None => Subject::Parameter(free[effect].name.clone()),
            Some(j) if j < nz => Subject::Force(model.states[j].name.clone()),
            Some(j) => Subject::Offset(model.measurements[j - nz].channel.clone()),
        }
    }

    /// The best explanation as a change.
    fn told(&self, ended: &Ended, explanations: &[Explanation]) -> Change {
        let (model, free, nz) = (&self.machine.model, &self.now.usual.free, self.machine.system.nz);
        let best = explanations[0];
        let (before, unit) = match best.effect.checked_sub(free.len()) {
            None => {
                let index = free[best.effect].index;
                (self.now.usual.values[index], model.parameters[index].unit.clone())
            }
            Some(j) if j < nz => (0.0, None),
            Some(j) => (0.0, Some(model.measurements[j - nz].unit.of_difference())),
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
    fn followed(&self, ended: &Ended) -> Change {
        let now = &self.now;
        let deviations = now.fit.deviations();
        let moved = |k: usize| {
            let index = now.usual.free[k].index;
            now.values[index] - now.usual.values[index]
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
            before: reported(unit, now.usual.values[index]),
            now: reported(unit, now.values[index]),
            std: difference(unit, deviations[most]),
            unit: unit.map(|u| u.text.clone()),
        }
    }

    /// A channel that scatters more or less than it did, in standard deviations of before.
    fn scatter_told(&self, ended: &Ended, change: &Settling, channel: usize) -> Change {
        let mean = change.means[ended.scores.gradient.len() + channel];
        let ratio = (0.5 * (ended.scatter[channel] - mean)).exp();
        Change {
            t: ended.t,
            subject: Subject::Noise(self.machine.model.measurements[channel].channel.clone()),
            or: Vec::new(),
            direction: if ratio > 1.0 { Direction::Up } else { Direction::Down },
            since: change.since,
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

    fn learned(&self) -> Learned {
        Learned {
            t: self.now.last.t,
            rate: 1.0 / self.now.usual.dt,
            block: self.now.block_seconds,
            alarms_per_day: self.now.alarms_per_day,
            charts: self.now.charts.len(),
            parameters: self.parameters(&self.now.fit.deviations()),
        }
    }

    fn estimates(&self, ended: &Ended) -> Estimates {
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

impl Saved {
    /// Whether its parts have the sizes that they have of each other: it may have been written by anybody.
    fn is_consistent(&self, system: &System) -> bool {
        let (np, nx, ny) = (self.usual.free.len(), system.nx, system.ny);
        let effects = np + system.nz + ny;
        let scores = |s: &Scores| s.gradient.len() == effects && s.information.len() == effects;
        let settles =
            |s: &Settling| s.means.len() == effects + ny && s.noise.is_none_or(|channel| channel < ny);
        let times = [self.block_seconds, self.memory, self.usual.dt, self.inflation, self.alarms_per_day];
        times.iter().all(|v| *v > 0.0)
            && self.values.len() == system.np
            && self.usual.rates.iter().all(|r| r.entry < nx)
            && self.usual.steps.count() > 0
            && self.rest.1.len() == nx
            && self.last.measured.len() == ny
            && self.keeping.shape() == Some((nx, effects, Effects::Everything))
            && self.following.shape() == Some((nx, np, Effects::Parameters))
            && self.fit.len() == np
            && self.fit.is_consistent()
            && self.charts.len() == effects + ny
            && self.charts.iter().all(Chart::is_consistent)
            && self.block.is_consistent(effects, ny)
            && self.history.iter().all(scores)
            && self.settling.as_ref().is_none_or(settles)
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

/// A block that has ended.
struct Ended {
    t: f64,
    scores: Scores,
    /// Per channel.
    scatter: Vec<f64>,
    block: Block,
}

impl Ended {
    /// The values of all charts.
    fn values(&self) -> Vec<f64> {
        let deviates = (0..self.scores.gradient.len()).map(|h| self.scores.deviate(h));
        deviates.chain(self.scatter.iter().copied()).collect()
    }
}

/// What a first pass over the learned seconds tells.
struct FirstPass {
    block_seconds: f64,
    rest: (Vec<f64>, Vec<f64>),
    inflation: f64,
}

/// Chooses the length of a block, and measures how far states and scores scatter.
fn first_pass(first: &First, options: &Options) -> Result<FirstPass, WatchError> {
    let First { machine, usual, start, samples } = first;
    let mut tracker = Tracker::new(machine, (&start.0, &start.1), Effects::Everything)?;
    let effects = tracker.count(machine);
    let by = Conditions { machine, usual, values: &usual.values, memory: options.memory };
    let seconds = samples[samples.len() - 1].t - samples[0].t;
    let count = (samples.len() / BLOCK_SAMPLES).clamp(BLOCKS.0, BLOCKS.1);
    let short = (seconds / count as f64).max(usual.dt);
    let mut block = Block::new(effects, machine.system.ny);
    let (mut blocks, mut began) = (Vec::new(), samples[0].t);
    let nx = machine.system.nx;
    let (mut sum, mut squares, mut count) = (vec![0.0; nx], vec![0.0; nx], 0.0);
    for pair in samples.windows(2) {
        if pair[1].t - pair[0].t > short {
            tracker.restart((&start.0, &start.1));
            block.clear();
            began = pair[1].t;
            continue;
        }
        if !tracker.advance(&by, &pair[0], &pair[1], |c, i| block.push(c, &i)) {
            return Err(WatchError::Diverged);
        }
        count += 1.0;
        for (i, x) in tracker.filter.state().iter().enumerate() {
            sum[i] += x;
            squares[i] += x * x;
        }
        if pair[1].t - began >= short - 0.5 * usual.dt {
            blocks.push(block.scores());
            block.clear();
            began = pair[1].t;
        }
    }
    // (The first block still feels where the filter began.)
    let blocks = &blocks[1.min(blocks.len())..];
    let count_together = together(blocks, FEWEST);
    let merged: Vec<Scores> = blocks.chunks_exact(count_together).map(Scores::sum).collect();
    let np = machine.free().len();
    let square: f64 = merged.iter().map(|s| (0..np).map(|h| s.deviate(h).powi(2)).sum::<f64>()).sum::<f64>();
    let inflation = (square / (merged.len() * np) as f64).max(1.0);
    let mean: Vec<f64> = sum.iter().map(|s| s / count).collect();
    let std = squares.iter().zip(&mean).map(|(s, m)| (s / count - m * m).max(0.0).sqrt()).collect();
    Ok(FirstPass { block_seconds: short * count_together as f64, rest: (mean, std), inflation })
}
