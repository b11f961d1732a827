//! Friction of a drive from its torque and its speed, one sample at a time, with an alarm where it changes. Without the
//! standard library: this is what runs on the controller board; `main.rs` tries it on a simulated drive.
#![no_std]

use greybox_recursive::{Chart, Direction, Filter, LeastSquares, Measured, Predicted, RecursiveError};

/// Samples whose rows make one number for the chart: longer than what one sample has to do with the next.
const BLOCK: u32 = 50;

/// What is known of the drive beforehand.
#[derive(Debug, Clone, Copy)]
pub struct Drive {
    /// kg m².
    pub inertia: f64,
    /// Time between two samples, s.
    pub step: f64,
    /// Noise of the measured speed, rad/s.
    pub noise: f64,
    /// What disturbs the speed from sample to sample, rad/s.
    pub ripple: f64,
}

/// Friction of a drive that turns forward.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Friction {
    /// N m s/rad.
    pub viscous: f64,
    /// N m.
    pub coulomb: f64,
}

/// The friction torque has changed at once.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Change {
    /// Which way.
    pub direction: Direction,
    /// How long ago it began, s.
    pub ago: f64,
}

/// J ω′ = torque − b ω − c: the state is filtered, b and c follow by least squares with forgetting.
#[derive(Debug, Clone)]
pub struct Tracker {
    drive: Drive,
    filter: Filter,
    fit: LeastSquares,
    chart: Chart,
    friction: Friction,
    memory: f64,
    /// Time until the chart judges, s: the fit follows first.
    quiet: f64,
    /// Samples of the present block, Σ ψ e and Σ ψ² of its innovations e and their derivatives ψ by c.
    block: (u32, f64, f64),
}

impl Tracker {
    /// Begins at a speed with what is believed of the friction and its standard deviations. A longer `memory` (s) scatters
    /// less and is later. The chart's false alarms are `false_alarms` s apart on the average.
    ///
    /// # Errors
    /// [`RecursiveError`] for numbers that are not finite or not positive.
    pub fn new(
        drive: Drive,
        speed: f64,
        [mean, deviation]: [Friction; 2],
        memory: f64,
        false_alarms: f64,
    ) -> Result<Self, RecursiveError> {
        let filter = Filter::new(&[speed], &[drive.noise], 2)?;
        let fit = LeastSquares::new(&[mean.viscous, mean.coulomb], &[deviation.viscous, deviation.coulomb])?;
        let chart = Chart::new(1.0, false_alarms / (f64::from(BLOCK) * drive.step))?;
        Ok(Self { drive, filter, fit, chart, friction: mean, memory, quiet: memory, block: (0, 0.0, 0.0) })
    }

    /// Takes the speed read now and the torque that acted since the reading before.
    pub fn update(&mut self, speed: f64, torque: f64) -> Option<Change> {
        let Drive { inertia, step, noise, ripple } = self.drive;
        let Friction { viscous, coulomb } = self.friction;
        let (rate, before) = (step / inertia, self.filter.state()[0]);
        let predicted = before + rate * (torque - viscous * before - coulomb);
        self.filter.predict(&Predicted {
            state: &[predicted],
            by_state: &[1.0 - rate * viscous],
            by_parameters: &[-rate * before, -rate],
            noise: &[ripple],
            memory: 1.0,
        });
        self.fit.forget(1.0 - step / self.memory);
        let sensor =
            Measured { error: speed - predicted, by_state: &[1.0], by_parameters: &[0.0, 0.0], noise };
        let (fit, (count, products, squares)) = (&mut self.fit, &mut self.block);
        self.filter.correct([sensor], |_, innovation| {
            let row = innovation.row;
            fit.update(row, innovation.value + row[0] * viscous + row[1] * coulomb);
            *count += 1;
            *products += row[1] * innovation.value;
            *squares += row[1] * row[1];
        });
        let mut found = [viscous, coulomb];
        self.fit.estimate_into(&mut found);
        self.filter.follow(&[found[0] - viscous, found[1] - coulomb]);
        self.friction = Friction { viscous: found[0], coulomb: found[1] };
        self.judge()
    }

    /// At the end of a block: by how much c would have to move to explain it goes into the chart.
    fn judge(&mut self) -> Option<Change> {
        let (count, products, squares) = self.block;
        if count < BLOCK {
            return None;
        }
        self.block = (0, 0.0, 0.0);
        let time = f64::from(count) * self.drive.step;
        if self.quiet > 0.0 {
            self.quiet -= time;
            return None;
        }
        let alarm = self.chart.push(products / squares)?;
        self.fit.restart();
        self.chart.restart();
        self.quiet = self.memory;
        let ago = alarm.since as f64 * time;
        Some(Change { direction: alarm.direction, ago })
    }

    /// The friction now.
    #[must_use]
    pub fn friction(&self) -> Friction {
        self.friction
    }

    /// Its standard deviations.
    #[must_use]
    pub fn deviation(&self) -> Friction {
        let found = self.fit.deviations();
        Friction { viscous: found[0], coulomb: found[1] }
    }
}
