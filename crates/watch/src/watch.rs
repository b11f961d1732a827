//! The watch: two filters, one that keeps to what is usual and one that follows the machine, and the charts.

use greybox_model::{Model, System};
use greybox_recording::{Recording, SIZES};
use greybox_recursive::{Chart, LeastSquares};

use crate::blocks::{Block, Ended};
use crate::error::WatchError;
use crate::event::{Clock, Event};
use crate::first_pass::first_pass;
use crate::identity::Identity;
use crate::learn::{First, Place, learn};
use crate::machine::Machine;
use crate::options::Options;
use crate::sample::Sample;
use crate::saved::{Known, Saved, VERSION};
use crate::tracker::{self, Conditions, Effects, Gate, Scratch, Tracker};

/// The change that a chart is quickest for, in standard deviations of one block.
const CHANGE: f64 = 1.0;

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
///
/// After an alarm the usual model is set free: everything that may change is estimated from the blocks since then, and the scores
/// are recursive residuals, which a change that settles leaves as they were. So the charts go on until it has settled.
#[derive(Debug, Clone)]
pub struct Watch {
    pub(crate) machine: Machine,
    pub(crate) now: Saved,
    scratch: Scratch,
    /// Memory of a sample: where the model is that follows the machine, its effects, and a row of its regression.
    followed: Place,
    at: Vec<f64>,
    row: Vec<f64>,
    /// Per channel, whether the value of a sample stands alone.
    alone: Vec<bool>,
}

impl Watch {
    fn new(machine: Machine, now: Saved) -> Watch {
        let followed = now.usual.place.clone();
        let (at, row, alone) = (Vec::new(), Vec::new(), vec![false; machine.system.ny]);
        Watch { machine, now, scratch: Scratch::default(), followed, at, row, alone }
    }

    /// Learns from the first seconds of a machine what is usual: parameters, noise, model error.
    ///
    /// # Errors
    /// [`WatchError`] where options make no sense, the recording does not have what the model needs or is too short, or the
    /// model cannot follow it.
    pub fn learn(model: &Model, first: &Recording, options: &Options) -> Result<(Watch, Event), WatchError> {
        options.check()?;
        let first = learn(model, first, options)?;
        let pass = first_pass(&first, options)?;
        let First { machine, usual, start, mut samples, irregular } = first;
        let adaptive = Tracker::new(&machine, (&start.0, &start.1), Effects::Parameters)?;
        let (mean, std): (Vec<f64>, Vec<f64>) =
            usual.free.iter().map(|f| (usual.place.values[f.index], f.std)).unzip();
        let charts = pass.tracker.count(&machine) + machine.system.ny;
        let mut covered = LeastSquares::new(&mean, &std)?;
        for (row, value) in pass.blocks.iter().flat_map(Block::all) {
            covered.update(&row[..mean.len()], value);
        }
        let between = charts as f64 * 86_400.0 / pass.block_seconds / options.alarms_per_day;
        let now = Saved {
            version: VERSION,
            model: Identity::of(model),
            alarms_per_day: options.alarms_per_day,
            memory: options.memory,
            block_seconds: pass.block_seconds,
            values: usual.place.values.clone(),
            fit: LeastSquares::new(&mean, &std)?,
            usual,
            rest: pass.rest,
            inflation: pass.inflation,
            wide: pass.wide,
            covered: covered.covariance(),
            gate: vec![tracker::Before::default(); machine.system.ny],
            reference: pass.tracker,
            adaptive,
            released: None,
            louder: None,
            charts: vec![Chart::new(CHANGE, between)?; charts],
            block: pass.begun.0,
            began: pass.begun.1,
            history: Vec::new(),
            last: samples.pop().ok_or(WatchError::Diverged)?,
            earlier: within(samples, machine.reach),
            settling: None,
            irregular,
            wait: (0, 1),
        };
        let mut watch = Watch::new(machine, now);
        pass.blocks.iter().for_each(|block| watch.learn_block(block));
        let now = &mut watch.now;
        now.adaptive.take_state(&now.reference);
        let change = now.usual.place.clone().go(&now.usual.free, &now.fit.estimate());
        now.usual.free.iter().zip(&change).for_each(|(f, d)| now.values[f.index] += d);
        now.adaptive.follow(&watch.machine, &change);
        let learned = watch.learned();
        Ok((watch, Event::Learned(learned)))
    }

    /// Takes a block of the learned seconds for what is usual.
    fn learn_block(&mut self, block: &Block) {
        let now = &mut self.now;
        let scores = block.scores();
        let values = scores.deviates().into_iter().chain(block.scatter(&scores));
        now.charts.iter_mut().zip(values).for_each(|(chart, v)| {
            // (What a chart takes for a change here is still part of what is usual.)
            if chart.push(v).is_some() {
                chart.restart();
            }
        });
        now.fit.forget((-now.block_seconds / now.memory).exp());
        let weight = 1.0 / now.inflation.sqrt();
        let at = now.usual.place.effects(&now.usual.free);
        let np = now.usual.free.len();
        for (row, value) in block.all() {
            let row: Vec<f64> = row[..np].iter().map(|r| weight * r).collect();
            let here: f64 = row.iter().zip(&at).map(|(r, a)| r * a).sum();
            now.fit.update(&row, weight * value + here);
        }
        now.remember(scores);
    }

    /// Goes on from a saved state.
    ///
    /// # Errors
    /// [`WatchError::OtherModel`] where the state is another model's; [`WatchError::Setup`] where the model does not compile.
    pub fn restore(model: &Model, saved: Saved) -> Result<Watch, WatchError> {
        let other = |what: String| Err(WatchError::OtherModel { what });
        if let Some(what) = saved.model.differs_from(model) {
            return other(what);
        }
        let system = System::compile(model).map_err(greybox_calibrate::SetupError::from)?;
        if saved.usual.place.values.len() != system.np || saved.usual.noise.len() != system.ny {
            return other("it has other parameters or channels".to_owned());
        }
        if saved.last.inputs.len() != system.nu || saved.rest.0.len() != system.nx {
            return other("it has other inputs or states".to_owned());
        }
        if let Some(f) = saved.usual.free.iter().find(|f| model.parameter(&f.name) != Some(f.index)) {
            return other(format!("the model has no parameter `{}` in that place", f.name));
        }
        let free = saved.usual.free.iter().map(|f| f.index).collect();
        let steps = saved.usual.steps.method();
        let machine = Machine::new(model.clone(), system.into(), steps, free, &saved.usual.place.values);
        if !saved.is_consistent(&machine) {
            return other("its parts do not fit together".to_owned());
        }
        Ok(Watch::new(machine, saved))
    }

    /// The state, to be saved.
    pub fn saved(&self) -> &Saved {
        &self.now
    }

    /// Takes the next sample: its time, inputs and measured values in SI and in the model's order, NaN for what is missing. A
    /// value beyond [`SIZES`] is taken for one that is missing.
    pub fn push(&mut self, t: f64, inputs: &[f64], measured: &[f64]) -> Vec<Event> {
        let mut events = Vec::new();
        let (last, dt) = (self.now.last.t, self.now.usual.dt);
        // (A time that is no number, or none that can be computed with, is none.)
        if !is_usable(t) || t <= last && t > last - self.now.block_seconds {
            let repeated = (t - last).abs() < 1e-6 * dt;
            let count =
                if repeated { &mut self.now.irregular.repeated } else { &mut self.now.irregular.late };
            *count += 1;
            return events;
        }
        let mut sample = Sample {
            t,
            inputs: inputs.to_vec(),
            measured: measured.iter().map(|v| Some(*v).filter(|v| is_usable(*v))).collect(),
        };
        sample.inputs.resize(self.machine.system.nu, f64::NAN);
        sample.measured.resize(self.machine.system.ny, None);
        self.now.irregular.not_measured += sample.measured.iter().filter(|v| v.is_none()).count() as u64;
        for (new, old) in sample.inputs.iter_mut().zip(&self.now.last.inputs) {
            if !is_usable(*new) {
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
        let mut trackers = vec![&mut now.reference, &mut now.adaptive];
        if let Some(before) = now.settling.as_mut().and_then(|s| s.before.as_mut()) {
            trackers.push(&mut before.tracker);
            before.block.clear();
        }
        for tracker in trackers {
            tracker.restart((&now.rest.0, &now.rest.1));
        }
        now.block.clear();
        now.earlier.clear();
        now.gate.fill(tracker::Before::default());
        (now.began, now.last) = (sample.t, sample);
    }

    /// Takes a sample; a block that has ended.
    fn advance(&mut self, mut sample: Sample) -> Option<Ended> {
        let kept = self.keep(&mut sample);
        let kept_up = self.follow(&sample);
        let now = &mut self.now;
        if !kept || !kept_up {
            now.irregular.diverged += 1;
            // Parameters with which the model cannot be simulated are none to go on from.
            if !kept && let Some(released) = &mut now.released {
                released.fit.restart();
                now.usual.place.go(&now.usual.free, &released.fit.estimate());
                released.restart(now.usual.place.effects(&now.usual.free));
            }
            if !kept_up {
                now.values.clone_from(&now.usual.place.values);
                now.fit.restart();
            }
            self.begin_anew(sample);
            return None;
        }
        let t = sample.t;
        let last = std::mem::replace(&mut now.last, sample);
        if self.machine.reach > 0.0 {
            now.earlier.push(last);
            forget(&mut now.earlier, t - self.machine.reach);
        }
        if t - now.began < now.block_seconds - 0.5 * now.usual.dt {
            return None;
        }
        now.began = t;
        Some(self.end_block(t))
    }

    /// The usual model takes a sample, and while a change settles, what was usual before. `false` where it leaves every bound. A
    /// measured value that stands alone is not used.
    fn keep(&mut self, sample: &mut Sample) -> bool {
        let (machine, now, scratch) = (&self.machine, &mut self.now, &mut self.scratch);
        let by = Conditions {
            machine,
            usual: &now.usual,
            place: &now.usual.place,
            memory: now.memory,
            earlier: &now.earlier,
        };
        let block = &mut now.block;
        let alone = &mut self.alone;
        alone.fill(false);
        let gate = Some(Gate { before: &mut now.gate, alone });
        let samples = (&now.last, &*sample);
        let kept = now.reference.advance(&by, samples, scratch, gate, |c, i| block.push(c, &i));
        for (value, _) in sample.measured.iter_mut().zip(&self.alone).filter(|(_, alone)| **alone) {
            *value = None;
            now.irregular.outliers += 1;
        }
        let samples = (&now.last, &*sample);
        if let Some(before) = now.settling.as_mut().and_then(|s| s.before.as_mut()) {
            let (tracker, block) = (&mut before.tracker, &mut before.block);
            let by = Conditions { place: &before.place, ..by };
            if !tracker.advance(&by, samples, scratch, None, |c, i| block.push(c, &i)) {
                tracker.restart((&now.rest.0, &now.rest.1));
                block.clear();
            }
        }
        kept
    }

    /// The model that follows the machine takes a sample. `false` where it leaves every bound.
    fn follow(&mut self, sample: &Sample) -> bool {
        let (machine, now, scratch) = (&self.machine, &mut self.now, &mut self.scratch);
        // (While a change settles, parameters alone are to explain it.)
        let before = now.settling.as_ref().and_then(|s| s.before.as_ref());
        let others = before.map_or(&now.usual.place, |b| &b.place);
        let place = &mut self.followed;
        place.values.clone_from(&now.values);
        place.forces.clone_from(&others.forces);
        place.offsets.clone_from(&others.offsets);
        let at = &mut self.at;
        at.clear();
        at.extend(now.usual.free.iter().map(|f| now.values[f.index]));
        let fit = &mut now.fit;
        fit.forget((-(sample.t - now.last.t) / now.memory).exp());
        let weight = 1.0 / now.inflation.sqrt();
        let row = &mut self.row;
        let by = Conditions { machine, usual: &now.usual, place, memory: now.memory, earlier: &now.earlier };
        let kept_up = now.adaptive.advance(&by, (&now.last, sample), scratch, None, |_, i| {
            row.clear();
            row.extend(i.row.iter().map(|psi| weight * psi));
            let here: f64 = row.iter().zip(&*at).map(|(r, a)| r * a).sum();
            fit.update(row, weight * i.value + here);
        });
        if kept_up {
            fit.estimate_into(at);
            let change = place.go(&now.usual.free, at);
            now.values.clone_from(&place.values);
            now.adaptive.follow(machine, &change);
        }
        kept_up
    }

    /// A block ends: what it says, and where what is usual moves by it.
    fn end_block(&mut self, t: f64) -> Ended {
        let now = &mut self.now;
        let empty = Block::new(now.reference.count(&self.machine), self.machine.system.ny);
        let block = std::mem::replace(&mut now.block, empty);
        let scores = block.scores();
        now.remember(scores.clone());
        let scatter = block.scatter(&scores);
        let deviates = match &now.released {
            Some(released) => released.deviates(&block),
            None => scores.deviates(),
        };
        let place = &mut now.usual.place;
        if let Some(released) = &mut now.released {
            let goes_on = released.learn(&block, &place.effects(&now.usual.free));
            let change = place.go(&now.usual.free, &released.fit.estimate());
            now.reference.follow(&self.machine, &change);
            if !goes_on {
                now.released = None;
            }
        }
        if let Some(louder) = &mut now.louder {
            let noise = &mut now.usual.noise[louder.channel];
            match louder.learn(scatter[louder.channel], *noise) {
                Some(next) => *noise = next,
                None => now.louder = None,
            }
        }
        if let Some(settling) = &mut now.settling
            && let Some(before) = &mut settling.before
        {
            before.history.push(before.block.scores());
            before.block.clear();
            settling.know(Known {
                t,
                fit: now.released.as_ref().map(|r| r.fit.clone()),
                values: now.values.clone(),
                deviations: now.fit.deviations(),
            });
        }
        Ended { t, scores, deviates, scatter, block }
    }
}

/// Whether a value can be computed with: a number whose square is one too, as the values of a recording ([`SIZES`]).
fn is_usable(value: f64) -> bool {
    value.abs() <= *SIZES.end()
}

/// Samples that are kept beyond those in reach, so that they are cut but now and then.
const SPARE: usize = 256;

/// Cuts off samples before `t`, but for the last of them.
fn forget(samples: &mut Vec<Sample>, t: f64) {
    let old = samples.partition_point(|s| s.t <= t).saturating_sub(1);
    if old > SPARE {
        samples.drain(..old);
    }
}

/// Those of the last seconds; none where none are remembered.
fn within(mut samples: Vec<Sample>, seconds: f64) -> Vec<Sample> {
    match samples.last().map(|last| last.t) {
        Some(end) if seconds > 0.0 => forget(&mut samples, end - seconds),
        _ => samples.clear(),
    }
    samples
}
