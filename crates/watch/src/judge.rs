//! What a block has to say: alarms, and what has become of them.

use greybox_recursive::{Chart, LeastSquares, RecursiveError};

use crate::blocks::{Block, Ended, Scores};
use crate::event::{Change, Event};
use crate::learn::WIDE;
use crate::naming::explanations;
use crate::released::{Louder, Released};
use crate::saved::{Before, Known, Settling};
use crate::watch::Watch;

/// Share of the memory after which a change is known so well that its linearisation is good.
const COARSE: f64 = 0.1;
/// Fewest blocks of a fit.
const FEWEST: f64 = 4.0;
/// Blocks that tell a mean.
const MANY: usize = 50;
/// Values of before among which a chart ranks new ones after a change.
const KEPT: usize = 200;
/// Most blocks that irregularities wait until they are reported.
const MOST_WAIT: u32 = 256;

impl Watch {
    /// What a block has to say.
    pub(crate) fn judge(&mut self, ended: &Ended, events: &mut Vec<Event>) {
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
        if self.now.settling.is_none()
            && let Some(outside) = self.outside(ended)
        {
            events.push(Event::Outside(outside));
            return;
        }
        if self.is_far(ended.t) {
            return;
        }
        if self.alarm(ended, events) {
            return;
        }
        if let Some(change) = self.now.settling.take_if(|change| ended.t >= change.until) {
            let found = self.settle(ended, change, ended.t);
            events.push(Event::Settled(found));
            self.now.released = None;
            self.now.charts.iter_mut().for_each(Chart::restart);
        }
    }

    /// Whether a change is not yet known so well that its linearisation is good. The fits begin once more then, where they are.
    fn is_far(&mut self, t: f64) -> bool {
        let now = &mut self.now;
        let Some(change) = &mut now.settling else { return false };
        let Some(again) = change.again else { return false };
        if t < again {
            return true;
        }
        let arrived = match &now.released {
            Some(released) if change.noise.is_none() => released.has_arrived(now.inflation),
            _ => true,
        };
        if arrived || t >= change.until {
            change.again = None;
            return false;
        }
        change.again = Some(t + (COARSE * now.memory).max(FEWEST * now.block_seconds));
        // (The fit that follows the machine forgets by itself what comes after the first time.)
        if !std::mem::replace(&mut change.begun_again, true) {
            now.fit.restart();
        }
        if let Some(released) = &mut now.released {
            released.restart(now.usual.place.effects(&now.usual.free));
        }
        true
    }

    /// Puts a block on the charts, and says what has changed where one exceeds its limit; what still settled is told before.
    fn alarm(&mut self, ended: &Ended, events: &mut Vec<Event>) -> bool {
        let now = &mut self.now;
        let means: Vec<f64> = now.charts.iter().map(Chart::mean).collect();
        let alarms: Vec<_> = now.charts.iter_mut().zip(ended.values()).map(|(c, v)| c.push(v)).collect();
        let alarms = alarms.iter().enumerate().filter_map(|(i, alarm)| alarm.map(|a| (i, a)));
        let Some((loudest, alarm)) = alarms.max_by(|(_, a), (_, b)| a.excess.total_cmp(&b.excess)) else {
            return false;
        };
        let effects = ended.scores.gradient.len();
        let noise = loudest.checked_sub(effects);
        let is_second = now.settling.is_some();
        for (k, chart) in now.charts.iter_mut().enumerate() {
            if is_second {
                chart.restart();
                continue;
            }
            let centred = noise.is_none() && k < effects;
            let mean = centred.then(|| mean_about_an_estimate(&now.history, k, alarm.since as usize));
            chart.resume(KEPT, alarm.since as usize, mean.flatten());
        }
        let all = explanations(&now.history, &means, alarm.since as usize);
        let blocks = if noise.is_some() { alarm.since as usize } else { all[0].blocks };
        let since = ended.t - blocks as f64 * now.block_seconds;
        if let Some(earlier) = now.settling.take() {
            let settled = self.settle(ended, earlier, since);
            events.push(Event::Settled(settled));
        }
        let mut change = Settling {
            until: ended.t + self.now.memory,
            again: Some(ended.t + (COARSE * self.now.memory).max(FEWEST * self.now.block_seconds)),
            begun_again: false,
            noise,
            since,
            means,
            before: None,
            trail: Vec::new(),
        };
        let found = match noise {
            Some(channel) => self.begin_louder(ended, &change, channel),
            None => {
                let found = self.effect_change(ended, &all, &self.now.usual.place);
                // (A place that is no number has diverged before it comes here.)
                change.before = self.release(blocks).ok();
                found
            }
        };
        events.push(Event::Changed(found));
        self.now.settling = Some(change);
        true
    }

    /// The scatter of a channel is followed from here on.
    fn begin_louder(&mut self, ended: &Ended, change: &Settling, channel: usize) -> Change {
        let now = &mut self.now;
        let noise = &mut now.usual.noise[channel];
        let mut louder = Louder::new(channel, *noise, change.means[ended.scores.gradient.len() + channel]);
        let first = *noise;
        *noise = louder.learn(ended.scatter[channel], first).unwrap_or(first);
        now.louder = Some(louder);
        let ratio = *noise / first;
        self.scatter_change(ended, change.since, channel, ratio)
    }

    /// Sets what is usual free, and keeps a filter that stays where it was since so many blocks.
    fn release(&mut self, blocks: usize) -> Result<Before, RecursiveError> {
        let now = &mut self.now;
        // What was known of the machine before the change is no longer so.
        now.fit.restart();
        let first = now.history.len().saturating_sub(blocks.max(1));
        let at = now.usual.place.effects(&now.usual.free);
        let fit = match now.released.take() {
            Some(released) => released.fit,
            None => {
                let known: Vec<f64> = now.wide.iter().map(|w| w / WIDE).collect();
                LeastSquares::new(&at, &known)?
            }
        };
        let before = Before {
            tracker: now.reference.clone(),
            place: now.usual.place.clone(),
            fit,
            block: Block::new(now.reference.count(&self.machine), self.machine.system.ny),
            history: now.history.split_off(first),
        };
        now.history.clear();
        now.released = Some(Released::new(&at, &now.wide)?);
        Ok(before)
    }

    /// What has changed is usual from here on, as far as it was known at a time: `end`.
    fn settle(&mut self, ended: &Ended, mut change: Settling, end: f64) -> Change {
        let Some(mut before) = change.before.take() else {
            let (channel, now) = (change.noise.unwrap_or(0), &self.now);
            let ratio = match &now.louder {
                Some(louder) if louder.channel == channel => now.usual.noise[channel] / louder.first,
                _ => 1.0,
            };
            return self.scatter_change(ended, change.since, channel, ratio);
        };
        let seconds = self.now.block_seconds;
        let after = ((ended.t - end) / seconds).round() as usize;
        before.history.truncate(before.history.len().saturating_sub(after).max(1));
        let blocks = ((end - change.since) / seconds).round() as usize;
        let all = explanations(&before.history, &change.means, blocks);
        let known = self.known(&change, end);
        let np = self.now.usual.free.len();
        let is_parameter = all[0].effect < np;
        let found = if is_parameter {
            self.parameter_change(ended, &known, &before.place)
        } else {
            self.effect_change(ended, &all, &before.place)
        };
        let named = all[0].effect;
        self.adopt(known, &before, |effect| if is_parameter { effect < np } else { effect == named });
        if !is_parameter {
            // (The followed parameters were to explain what they do not.)
            let now = &mut self.now;
            now.values.clone_from(&now.usual.place.values);
            now.adaptive.take_state(&now.reference);
            now.fit.restart();
        }
        Change { since: change.since, ..found }
    }

    /// What was known of a change at a time.
    fn known(&self, change: &Settling, end: f64) -> Known {
        let early = 0.5 * self.now.block_seconds;
        let then = change.trail.iter().rev().find(|k| k.t <= end + early).or(change.trail.first());
        then.cloned().unwrap_or_else(|| Known {
            t: end,
            fit: self.now.released.as_ref().map(|r| r.fit.clone()),
            values: self.now.values.clone(),
            deviations: self.now.fit.deviations(),
        })
    }

    /// What is known of the effects that have changed is usual; of the others, what was known before and since.
    fn adopt(&mut self, known: Known, before: &Before, changed: impl Fn(usize) -> bool) {
        let now = &mut self.now;
        let (Some(mut fit), Some(released)) = (known.fit, &mut now.released) else { return };
        fit.merge(&before.fit, |effect| !changed(effect));
        let change = now.usual.place.go(&now.usual.free, &fit.estimate());
        released.fit = fit;
        now.reference.follow(&self.machine, &change);
    }
}

/// Mean of an effect's deviates about its own estimate, of the blocks but the last ones: that of those to come where a model errs,
/// and strong blocks say something else than weak ones. `None` where there are few.
fn mean_about_an_estimate(history: &[Scores], effect: usize, without: usize) -> Option<f64> {
    let blocks = &history[..history.len().saturating_sub(without)];
    if blocks.len() < MANY {
        return None;
    }
    let (change, _) = Scores::sum(blocks).change(effect);
    let left = |s: &Scores| s.deviate(effect) - change * s.information[effect].sqrt();
    Some(blocks.iter().map(left).sum::<f64>() / blocks.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Weak blocks in which an effect is 1, and as many strong ones in which it is 3: about their estimate, which the strong ones
    /// determine, deviates have a mean below zero.
    #[test]
    fn deviates_about_an_estimate_need_not_have_the_mean_zero() {
        let scores = |information: f64, effect: f64| Scores {
            gradient: vec![information * effect],
            information: vec![information],
            squares: 1.0,
            count: 1.0,
        };
        let mut history: Vec<Scores> =
            (0..100).map(|k| if k % 2 == 0 { scores(1.0, 1.0) } else { scores(9.0, 3.0) }).collect();
        history.extend((0..5).map(|_| scores(4.0, 100.0)));
        // The estimate: (1 + 27)/10.
        let expected = 0.5 * ((1.0 - 2.8) + 3.0 * (3.0 - 2.8));
        let mean = mean_about_an_estimate(&history, 0, 5).unwrap();
        assert!((mean - expected).abs() < 1e-12, "{mean} {expected}");
        assert_eq!(mean_about_an_estimate(&history[..40], 0, 5), None);
    }
}
