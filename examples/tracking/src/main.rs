//! The tracker on a simulated drive: `cargo run --release --package example-tracking`.
#![allow(clippy::print_stdout)]

use example_tracking::{Change, Drive, Friction, Tracker};
use greybox_recursive::RecursiveError;

/// A conveyor, 50 samples a second.
const DRIVE: Drive = Drive { inertia: 0.02, step: 0.02, noise: 0.05, ripple: 0.02 };
/// Memory of the tracker, s.
const MEMORY: f64 = 40.0;
/// Time at which a bearing fails, s, and by what its friction rises, N m.
const FAILURE: (f64, f64) = (400.0, 0.02);

/// What the grease stiffens by, N m s/rad in a second.
const DRIFT: f64 = 5e-7;

/// The grease stiffens all the time; a bearing fails once.
fn friction(t: f64) -> Friction {
    let failed = if t < FAILURE.0 { 0.0 } else { FAILURE.1 };
    Friction { viscous: 0.002 + DRIFT * t, coulomb: 0.05 + failed }
}

/// What is known after a sample.
struct Known {
    t: f64,
    friction: Friction,
    deviation: Friction,
    change: Option<Change>,
}

/// The drive over 600 s.
fn run(seed: u32) -> Result<Vec<Known>, RecursiveError> {
    let believed = [friction(0.0), Friction { viscous: 1e-3, coulomb: 0.03 }];
    let mut tracker = Tracker::new(DRIVE, 60.0, believed, MEMORY, 86_400.0)?;
    let (mut speed, mut torque, mut noise) = (60.0, 0.0, Noise(seed));
    let mut out = Vec::new();
    for sample in 0..30_000 {
        let t = DRIVE.step * f64::from(sample);
        let change = tracker.update(speed + DRIVE.noise * noise.next(), torque);
        out.push(Known { t, friction: tracker.friction(), deviation: tracker.deviation(), change });
        // The speed control knows nothing of what changes.
        let wanted = 60.0 + 30.0 * (0.5 * t).sin() + 10.0 * (1.3 * t).sin();
        torque = 0.17 + 0.05 * (wanted - speed);
        let Friction { viscous, coulomb } = friction(t);
        for _ in 0..10 {
            speed += 0.1 * DRIVE.step / DRIVE.inertia * (torque - viscous * speed - coulomb);
        }
        speed += DRIVE.ripple * noise.next();
    }
    Ok(out)
}

/// Normal noise of variance 1, nearly: the sum of twelve uniform numbers (Numerical Recipes' generator).
struct Noise(u32);

impl Noise {
    fn next(&mut self) -> f64 {
        let mut uniform = || {
            self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(self.0) / f64::from(u32::MAX) - 0.5
        };
        (0..12).map(|_| uniform()).sum()
    }
}

fn main() -> Result<(), RecursiveError> {
    println!("time   viscous, mN m s/rad     true   Coulomb, mN m    true");
    for (sample, Known { t, friction: found, deviation, change }) in run(7)?.into_iter().enumerate() {
        if let Some(Change { direction, ago }) = change {
            println!("{t:.0} s: the friction torque went {direction:?}, {ago:.0} s ago");
        }
        if sample % 2500 == 2499 {
            let truth = friction(t);
            println!(
                "{t:3.0} s  {:.3} ± {:.3}           {:.3}  {:.2} ± {:.2}     {:.2}",
                1e3 * found.viscous,
                1e3 * deviation.viscous,
                1e3 * truth.viscous,
                1e3 * found.coulomb,
                1e3 * deviation.coulomb,
                1e3 * truth.coulomb
            );
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_recursive::Direction;

    #[test]
    fn the_failure_is_seen_once_and_the_friction_followed() {
        let (mut lags, mut squares, mut errors) = (0.0, 0.0, 0.0);
        for seed in 0..20 {
            let out = run(seed).unwrap();
            let alarms: Vec<(f64, Change)> = out.iter().filter_map(|k| Some((k.t, k.change?))).collect();
            let [(t, change)] = alarms[..] else { panic!("{alarms:?}") };
            assert_eq!(change.direction, Direction::Up);
            assert!(
                (FAILURE.0..FAILURE.0 + 8.0).contains(&t) && (4.0..20.0).contains(&change.ago),
                "{t} {change:?}"
            );

            let settled = &out[7500..20_000];
            for Known { t, friction: found, deviation, .. } in settled {
                let behind = friction(*t).viscous - found.viscous;
                lags += behind / DRIFT / settled.len() as f64 / 20.0;
                squares +=
                    ((behind - DRIFT * MEMORY) / deviation.viscous).powi(2) / settled.len() as f64 / 20.0;
            }
            let later = &out[21_250];
            errors += (later.friction.coulomb - friction(later.t).coulomb).powi(2) / 20.0;
        }
        // What drifts is followed one memory later, and scatters by half of the variance of what may move.
        assert!((0.75..1.35).contains(&(lags / MEMORY)), "{lags} s");
        assert!((0.25..0.9).contains(&squares), "{squares}");
        // 20 s after the alarm, a tenth of the failure.
        assert!((1e-3..4e-3).contains(&errors.sqrt()), "{errors}");
    }
}
