//! The watch: two filters, one that keeps to what is usual and one that follows the machine, and the charts.

use greybox_model::{Model, System};
use greybox_recording::Recording;
use greybox_recursive::{Chart, LeastSquares};

use crate::blocks::{Block, Ended};
use crate::error::WatchError;
use crate::event::{Change, Clock, Event, Irregular, Subject};
use crate::first_pass::{FirstPass, first_pass};
use crate::learn::{First, Sample, learn};
use crate::machine::Machine;
use crate::naming::explanations;
use crate::options::Options;
use crate::saved::{Saved, Settling, VERSION};
use crate::tracker::{Conditions, Effects, Tracker};

/// The change that a chart is quickest for, in standard deviations of one block.
const CHANGE: f64 = 1.0;
/// Blocks that are remembered to tell how large a change is.
const REMEMBERED: usize = 512;
/// Share of the memory after which a change is known so well that its linearisation is good.
const COARSE: f64 = 0.1;
/// Most blocks that irregularities wait until they are reported.
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
    pub(crate) machine: Machine,
    pub(crate) now: Saved,
}

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
        let reference = Tracker::new(&machine, (state, deviation), Effects::Everything)?;
        let adaptive = Tracker::new(&machine, (state, deviation), Effects::Parameters)?;
        let (mean, std): (Vec<f64>, Vec<f64>) =
            usual.free.iter().map(|f| (usual.values[f.index], f.std)).unzip();
        let effects = reference.count(&machine);
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
            reference,
            adaptive,
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
        for tracker in [&mut now.reference, &mut now.adaptive] {
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
        let kept = now.reference.advance(&usual, &now.last, &sample, |c, i| block.push(c, &i));
        let free = &now.usual.free;
        let at: Vec<f64> = free.iter().map(|f| now.values[f.index]).collect();
        let followed = Conditions { values: &now.values, ..usual };
        let fit = &mut now.fit;
        fit.forget((-(sample.t - now.last.t) / now.memory).exp());
        let weight = 1.0 / now.inflation.sqrt();
        let mut row = vec![0.0; at.len()];
        let kept_up = now.adaptive.advance(&followed, &now.last, &sample, |_, i| {
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
        now.adaptive.filter.follow(&change);
        let t = sample.t;
        now.last = sample;
        if t - now.began < now.block_seconds - 0.5 * now.usual.dt {
            return None;
        }
        now.began = t;
        let empty = Block::new(now.reference.count(&self.machine), self.machine.system.ny);
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
        let found = match noise {
            Some(channel) => self.scatter_change(ended, &change, channel),
            None => {
                let all = explanations(&now.history, &change.means, alarm.since as usize);
                change.since = ended.t - all[0].blocks as f64 * now.block_seconds;
                // What was known of the machine before the change is no longer so.
                now.fit.restart();
                self.effect_change(ended, &all)
            }
        };
        self.now.settling = Some(change);
        Some(found)
    }

    /// From here on what has changed is usual.
    fn settle(&mut self, ended: &Ended, change: &Settling) -> Change {
        let found = match change.noise {
            Some(channel) => self.scatter_change(ended, change, channel),
            None => {
                let blocks = ((ended.t - change.since) / self.now.block_seconds).round() as usize;
                let all = explanations(&self.now.history, &change.means, blocks);
                let np = self.now.usual.free.len();
                if all[0].effect < np {
                    self.parameter_change(ended)
                } else {
                    self.effect_change(ended, &all)
                }
            }
        };
        let found = Change { since: change.since, ..found };
        let now = &mut self.now;
        if matches!(found.subject, Subject::Parameter(_)) {
            now.usual.values.clone_from(&now.values);
            now.reference.filter.take_state(&now.adaptive.filter);
        }
        now.charts.iter_mut().for_each(Chart::restart);
        now.history.clear();
        found
    }
}
