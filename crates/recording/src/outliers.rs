//! Samples that do not belong to their signal.
//!
//! An outlier is isolated: it departs from what the samples on its left say and from what those on its right say, and these
//! two agree with each other. A step agrees with one side, a corner with both. So a window of samples is explained by a
//! polynomial and one of three things: a spike in its middle, a step beside it, a corner. An outlier is a spike that
//! explains more than any of the others would.

use crate::median::median;
use crate::noise::{finite_range, quantisation_step};

/// Samples on either side of a window, and powers of its polynomial: short ones and many powers for fast signals, long
/// ones and few powers for noise.
const WINDOWS: [(usize, i32); 4] = [(3, 4), (4, 4), (5, 4), (5, 6)];

/// Least size of an outlier, in standard deviations of what no polynomial explains; in those of its neighbourhood, which
/// are known less well.
const BEYOND: f64 = 6.0;
const LOCALLY: f64 = 5.0;

/// Samples on either side by which it is judged how the signal moves there, and fewest that make a scale of their own.
const NEARBY: usize = 32;
const FEWEST: usize = 8;

/// Places at which a signal jumps by this share of a departure: such a signal departs so by itself.
const PLACES: usize = 2;
const JUMP: f64 = 0.75;

/// Magnitudes of a normal distribution below which half and 95 % of it lie, in standard deviations.
const HALF: f64 = 0.674_49;
const MOST: f64 = 1.959_96;

/// Indices of the outliers of a uniformly sampled signal.
///
/// `rails` are the values at which it is clipped: behind them nobody knows how it moved, so that no sample near them stands
/// out. The scale is the largest of that of the whole signal, of its neighbourhood and of the quantisation step. Where
/// the signal stands still it has none; only samples among some that move tell what is usual.
pub(crate) fn outliers(y: &[f64], rails: &[f64]) -> Vec<usize> {
    let Some((low, high)) = finite_range(y) else { return Vec::new() };
    let tolerance = 1e-9 * (high - low);
    let seen = WINDOWS.map(|window| Seen::of(y, &Shapes::of(window), rails, tolerance));
    // The window that leaves least beside a spike.
    let Some(seen) = seen.iter().filter(|s| s.scale > 0.0).min_by(|a, b| a.scale.total_cmp(&b.scale)) else {
        return Vec::new();
    };
    let least = BEYOND * seen.scale.max(quantisation_step(y).unwrap_or(0.0));
    let isolated: Vec<usize> = (0..seen.spike.len())
        .filter(|&k| seen.spike[k].abs() > least && seen.spike[k].abs() > seen.other[k])
        .collect();
    // What an outlier does to its neighbours says nothing about the signal.
    let mut disturbed = vec![false; seen.spike.len()];
    let width = 2 * seen.reach;
    for &k in &isolated {
        disturbed[k.saturating_sub(width)..(k + width + 1).min(seen.spike.len())].fill(true);
    }
    let mut jumps: Vec<f64> = Vec::new();
    let mut last = None;
    for k in (0..seen.spike.len()).filter(|&k| !disturbed[k] && seen.step[k] > least) {
        match (last, jumps.last_mut()) {
            // The same step, seen from the next sample.
            (Some(before), Some(jump)) if k - before <= width => *jump = jump.max(seen.step[k]),
            _ => jumps.push(seen.step[k]),
        }
        last = Some(k);
    }
    let stands_out = |&k: &usize| {
        let size = seen.spike[k].abs();
        let nearby = k.saturating_sub(NEARBY)..(k + NEARBY + 1).min(seen.spike.len());
        let local: Vec<f64> =
            nearby.filter(|&i| !disturbed[i]).map(|i| seen.spike[i].abs()).filter(|s| !s.is_nan()).collect();
        let own = if local.len() < FEWEST { 0.0 } else { median(&local) / HALF };
        size > LOCALLY * own && jumps.iter().filter(|jump| **jump > JUMP * size).count() < PLACES
    };
    isolated.iter().filter(|k| stands_out(k)).map(|&k| k + seen.reach).collect()
}

/// How large a spike, and how large other things would be, window by window; NaN where a window tells nothing: the signal
/// stands still in it, is clipped, or a sample is missing.
struct Seen {
    reach: usize,
    /// Size of a spike in the middle.
    spike: Vec<f64>,
    /// Size of a spike that would explain as much as the best of steps and corners.
    other: Vec<f64>,
    /// Size of a step on either side of the middle.
    step: Vec<f64>,
    /// Usual size of a spike, as a standard deviation.
    scale: f64,
}

impl Seen {
    fn of(y: &[f64], shapes: &Shapes, rails: &[f64], tolerance: f64) -> Seen {
        let clipped = |v: f64| rails.iter().any(|rail| (v - rail).abs() <= tolerance);
        let length = 2 * shapes.reach + 1;
        let windows = y.len().saturating_sub(length - 1);
        let mut seen = Seen {
            reach: shapes.reach,
            spike: Vec::with_capacity(windows),
            other: Vec::with_capacity(windows),
            step: Vec::with_capacity(windows),
            scale: f64::NAN,
        };
        for w in y.windows(length) {
            let mute = w.iter().all(|v| *v == w[0]) || w.iter().any(|&v| v.is_nan() || clipped(v));
            let size = |shape: &Shape| if mute { f64::NAN } else { shape.explains(w) };
            seen.spike.push(size(&shapes.spike) / shapes.spike.length);
            let steps = shapes.steps.each_ref().map(|s| size(s).abs());
            let corners = shapes.corners.each_ref().map(|s| size(s).abs());
            let most = |of: &[f64]| of.iter().copied().fold(0.0, f64::max);
            seen.other.push(most(&steps).max(most(&corners)) / shapes.spike.length);
            seen.step.push(most(&steps) / shapes.steps[0].length);
        }
        let mut sizes: Vec<f64> = seen.spike.iter().map(|s| s.abs()).filter(|s| !s.is_nan()).collect();
        if !sizes.is_empty() {
            sizes.sort_unstable_by(f64::total_cmp);
            // Of noise with heavy tails, and of a signal that is seldom fast, the larger one tells more.
            let quantile = |share: f64| sizes[((share * sizes.len() as f64) as usize).min(sizes.len() - 1)];
            seen.scale = (quantile(0.5) / HALF).max(quantile(0.95) / MOST);
        }
        seen
    }
}

/// What may be in a window beside a polynomial.
struct Shapes {
    reach: usize,
    spike: Shape,
    steps: [Shape; 2],
    corners: [Shape; 3],
}

impl Shapes {
    fn of((reach, powers): (usize, i32)) -> Shapes {
        let end = reach as f64;
        let x: Vec<f64> = (0..=2 * reach).map(|k| k as f64 - end).collect();
        let mut polynomials: Vec<Vec<f64>> = Vec::new();
        for power in 0..powers {
            let column = without(&x.iter().map(|x| (x / end).powi(power)).collect::<Vec<_>>(), &polynomials);
            let length = dot(&column, &column).sqrt();
            polynomials.push(column.iter().map(|v| v / length).collect());
        }
        let shape =
            |of: &dyn Fn(f64) -> f64| Shape::of(&x.iter().map(|&x| of(x)).collect::<Vec<_>>(), &polynomials);
        Shapes {
            reach,
            spike: shape(&|x| if x == 0.0 { 1.0 } else { 0.0 }),
            steps: [-0.5, 0.5].map(|at| shape(&|x| if x > at { 1.0 } else { 0.0 })),
            corners: [-1.0, 0.0, 1.0].map(|at| shape(&|x| (x - at).abs())),
        }
    }
}

/// A shape, of which a polynomial explains nothing.
struct Shape {
    /// Of length one.
    weights: Vec<f64>,
    /// Of the shape as it was, less what a polynomial explains.
    length: f64,
}

impl Shape {
    fn of(values: &[f64], polynomials: &[Vec<f64>]) -> Shape {
        let rest = without(values, polynomials);
        let length = dot(&rest, &rest).sqrt();
        Shape { weights: rest.iter().map(|v| v / length).collect(), length }
    }

    /// Root of the sum of squares that it explains in a window, with the sign of its size.
    fn explains(&self, w: &[f64]) -> f64 {
        // Less the middle, so that the offset of a signal costs no digits.
        let middle = w[w.len() / 2];
        self.weights.iter().zip(w).map(|(a, v)| a * (v - middle)).sum()
    }
}

/// What is left of `values` beside orthonormal columns.
fn without(values: &[f64], columns: &[Vec<f64>]) -> Vec<f64> {
    let mut rest = values.to_vec();
    for column in columns {
        let share = dot(&rest, column);
        rest.iter_mut().zip(column).for_each(|(r, c)| *r -= share * c);
    }
    rest
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_nothing_and_every_shape_is_best_explained_by_itself() {
        for window in WINDOWS {
            let (reach, shapes) = (window.0, Shapes::of(window));
            let x: Vec<f64> = (0..=2 * reach).map(|k| k as f64 - reach as f64).collect();
            let cubic: Vec<f64> = x.iter().map(|x| 1.0 + 2.0 * x - 0.5 * x * x + 0.25 * x * x * x).collect();
            assert!(shapes.spike.explains(&cubic).abs() < 1e-12);
            let all: Vec<&Shape> =
                [&shapes.spike].into_iter().chain(&shapes.steps).chain(&shapes.corners).collect();
            for (k, shape) in all.iter().enumerate() {
                let w: Vec<f64> = shape.weights.iter().zip(&cubic).map(|(s, c)| 3.0 * s + c).collect();
                for (other, by) in all.iter().enumerate() {
                    let size = by.explains(&w).abs();
                    assert!(
                        if other == k { (size - 3.0).abs() < 1e-9 } else { size < 2.99 },
                        "{reach} {k} {other} {size}"
                    );
                }
            }
        }
    }

    /// A sine with 60 samples to a period, and what is done to it.
    fn sine(edit: impl FnOnce(&mut Vec<f64>)) -> Vec<usize> {
        let mut y: Vec<f64> = (0..600).map(|k| (std::f64::consts::TAU * f64::from(k) / 60.0).sin()).collect();
        edit(&mut y);
        outliers(&y, &[])
    }

    #[test]
    fn one_sample_stands_out_and_steps_corners_and_ends_do_not() {
        assert!(sine(|_| ()).is_empty());
        assert_eq!(sine(|y| y[100] += 0.2), [100]);
        assert_eq!(sine(|y| y[100] -= 0.2), [100]);
        assert_eq!(sine(|y| (y[100], y[110]) = (9.0, -9.0)), [100, 110]);
        assert!(sine(|y| y[100..].iter_mut().for_each(|v| *v += 0.5)).is_empty(), "a step");
        assert!(sine(|y| y[300..].iter_mut().for_each(|v| *v = v.abs())).is_empty(), "corners");
        assert!(
            sine(|y| (0..3).for_each(|i| y[100 + i] += 0.25 * (i + 1) as f64)).is_empty(),
            "a ramp over some samples"
        );
        assert!(outliers(&[], &[]).is_empty() && outliers(&[f64::NAN; 40], &[]).is_empty());
        assert!(outliers(&[1.0; 40], &[]).is_empty());
    }

    #[test]
    fn nothing_is_said_beside_missing_and_clipped_samples() {
        assert!(sine(|y| (y[100], y[102]) = (9.0, f64::NAN)).is_empty());
        let mut y: Vec<f64> =
            (0..600).map(|k| (std::f64::consts::TAU * f64::from(k) / 60.0).sin().min(0.8)).collect();
        // Behind the rail the signal dipped for one sample.
        y[15] = 0.5;
        assert_eq!(outliers(&y, &[]), [15]);
        assert!(outliers(&y, &[0.8]).is_empty());
    }
}
