//! Forces of free shape: what acts on a machine and has no name.
//!
//! Piecewise linear functions of the motion d (7 knots), of d' (7), of both (5 × 5), of their product (15), of its product
//! with another motion (9), of each input (7) and its products with d and d' (7), and of slow time (14 knots, alone and as
//! a gain of d, d', d² and each input).
//!
//! As a hypothesis, a shape is a Gaussian process (Rasmussen and Williams, *Gaussian Processes for Machine Learning*, 2006,
//! ch. 2): its values a at the knots are normal with covariance K. Along a fitted model the residuals r are linear in them,
//! r = G a + e, with e of unit variance and every square worth w of one that is independent. With the parameters projected
//! off, what the shape adds to the logarithm of the marginal likelihood is
//!
//! ```text
//! ΔlnZ = ½ bᵀ A⁻¹ b − ½ ln |A|,    A = I + w Lᵀ GᵀG L,    b = w Lᵀ Gᵀ r,    K = L Lᵀ
//! ```

use std::ops::Range;

use greybox_calibrate::{Setup, qr};

use crate::marginal::log_marginal;
use crate::place::{Motion, Place, places};
use crate::screen::Component;
use crate::trajectory::TrajectoryEval;

/// Knots of slow time over a recording.
const SLOW_KNOTS: usize = 14;

/// A variable of the free shapes.
#[derive(Debug, Clone, PartialEq)]
pub enum Variable {
    /// Position of a motion.
    Position(Motion),
    /// Rate of a motion.
    Rate(Motion),
    /// Both.
    Both(Motion),
    /// The product of two motions, acting on the first.
    Product(Motion, Motion),
    /// An input (or its product with the motion), acting where the motion acts.
    Input(usize, Motion),
    /// Slow time.
    Time(Motion),
}

impl Variable {
    /// The motion that the force acts on.
    pub fn motion(&self) -> &Motion {
        match self {
            Variable::Position(m)
            | Variable::Rate(m)
            | Variable::Both(m)
            | Variable::Product(m, _)
            | Variable::Input(_, m)
            | Variable::Time(m) => m,
        }
    }
}

fn knots(values: &[Vec<f64>], n: usize, rare: f64) -> Option<Vec<f64>> {
    let mut all: Vec<f64> = values.iter().flatten().copied().filter(|v| v.is_finite()).collect();
    if all.len() < 4 * n {
        return None;
    }
    all.sort_by(f64::total_cmp);
    // Evenly in value.
    let cut = (all.len() as f64 * rare) as usize;
    let (lo, hi) = (all[cut], all[all.len() - 1 - cut]);
    (hi > lo).then(|| (0..n).map(|i| lo + (hi - lo) * i as f64 / (n - 1) as f64).collect())
}

/// Hat function `i` over even knots.
fn hat(knots: &[f64], i: usize, v: f64) -> f64 {
    let h = knots[1] - knots[0];
    let v = v.clamp(knots[0], knots[knots.len() - 1]);
    (1.0 - ((v - knots[i]) / h).abs()).max(0.0)
}

/// Functions of one variable.
#[derive(Debug, Clone)]
pub struct Group {
    /// The variable.
    pub variable: Variable,
    /// Its functions among all.
    pub columns: Range<usize>,
    /// Knots of each of two variables.
    knots: (usize, usize),
}

/// All free shapes along a trajectory.
#[derive(Debug)]
pub struct Shapes {
    /// The functions, variable by variable.
    pub groups: Vec<Group>,
    /// Their values.
    pub forces: Vec<Component>,
}

impl Shapes {
    /// Evaluates them; `None` where no motion has a shape. Beyond quantiles of `rare` and 1 − `rare` of its variable a
    /// function stays as it is there.
    pub fn along(setup: &Setup, along: &TrajectoryEval<'_>, rare: f64) -> Option<Shapes> {
        let motions: Vec<Motion> = places(&setup.model)
            .into_iter()
            .filter_map(|p| match p {
                Place::Motion(m) if m.weights.iter().filter(|w| **w != 0.0).count() == 1 => Some(m),
                _ => None,
            })
            .take(3)
            .collect();
        let mut forces: Vec<Component> = Vec::new();
        let mut groups: Vec<Group> = Vec::new();
        let pieces = &setup.data.pieces;
        // A constant has no shape, and its products repeat what they are made of.
        let inputs: Vec<usize> = (0..setup.system.nu).filter(|u| setup.data.input_varies(*u)).collect();
        for motion in &motions {
            let eval = |e: &Option<greybox_model::Expr>| {
                e.as_ref().and_then(|e| along.eval(std::slice::from_ref(e), &[])?.pop())
            };
            let (d, v) = (eval(&motion.position), eval(&motion.rate));
            let mut push = |variable: Variable, made: Vec<Vec<Vec<f64>>>, knots: (usize, usize)| {
                if made.is_empty() {
                    return;
                }
                let first = forces.len();
                forces
                    .extend(made.into_iter().map(|values| Component::Force(motion.weights.clone(), values)));
                groups.push(Group { variable, columns: first..forces.len(), knots });
            };
            let shapes = |series: &Vec<Vec<f64>>, n: usize| -> Vec<Vec<Vec<f64>>> {
                let Some(k) = knots(series, n, rare) else { return Vec::new() };
                (0..n)
                    .map(|i| series.iter().map(|s| s.iter().map(|x| hat(&k, i, *x)).collect()).collect())
                    .collect()
            };
            if let Some(d) = &d {
                push(Variable::Position(motion.clone()), shapes(d, 7), (1, 7));
            }
            if let Some(v) = &v {
                push(Variable::Rate(motion.clone()), shapes(v, 7), (1, 7));
            }
            if let (Some(d), Some(v)) = (&d, &v)
                && let (Some(kd), Some(kv)) = (knots(d, 5, rare), knots(v, 5, rare))
            {
                let mut both = Vec::new();
                for i in 0..5 {
                    for j in 0..5 {
                        both.push(
                            d.iter()
                                .zip(v)
                                .map(|(d, v)| {
                                    d.iter().zip(v).map(|(d, v)| hat(&kd, i, *d) * hat(&kv, j, *v)).collect()
                                })
                                .collect(),
                        );
                    }
                }
                push(Variable::Both(motion.clone()), both, (5, 5));
            }
            let times_series = |a: &[Vec<f64>], b: &[Vec<f64>]| -> Vec<Vec<f64>> {
                a.iter().zip(b).map(|(a, b)| a.iter().zip(b).map(|(a, b)| a * b).collect()).collect()
            };
            if let (Some(d), Some(v)) = (&d, &v) {
                push(Variable::Both(motion.clone()), shapes(&times_series(d, v), 15), (1, 15));
            }
            for other in &motions {
                if other != motion
                    && let (Some(d), Some(o)) = (&d, eval(&other.position))
                {
                    push(
                        Variable::Product(motion.clone(), other.clone()),
                        shapes(&times_series(d, &o), 9),
                        (1, 9),
                    );
                }
            }
            for &u in &inputs {
                let series: Vec<Vec<f64>> = pieces.iter().map(|p| p.inputs[u].clone()).collect();
                push(Variable::Input(u, motion.clone()), shapes(&series, 7), (1, 7));
                for of in [&d, &v].into_iter().flatten() {
                    push(Variable::Input(u, motion.clone()), shapes(&times_series(&series, of), 7), (1, 7));
                }
            }
            let times: Vec<Vec<f64>> =
                pieces.iter().map(|p| (0..p.len).map(|k| p.start + k as f64 * p.dt).collect()).collect();
            // What a force of slow time, and the gains of the motion and of the inputs, would be if they changed.
            let slow = shapes(&times, SLOW_KNOTS);
            let mut factors: Vec<Option<Vec<Vec<f64>>>> = vec![None];
            factors.extend([&d, &v].into_iter().flatten().cloned().map(Some));
            factors.extend(d.iter().map(|d| Some(times_series(d, d))));
            factors
                .extend(inputs.iter().map(|&u| Some(pieces.iter().map(|p| p.inputs[u].clone()).collect())));
            for factor in factors {
                let gains = slow.iter().map(|shape| match &factor {
                    None => shape.clone(),
                    Some(f) => times_series(shape, f),
                });
                push(Variable::Time(motion.clone()), gains.collect(), (1, SLOW_KNOTS));
            }
        }
        if forces.is_empty() {
            return None;
        }
        Some(Shapes { groups, forces })
    }
}

impl Group {
    /// Covariance of the values at the knots, of variance one. Neighbours are alike, and no more: what is alike over many knots
    /// is a straight line, and has a name.
    fn covariance(&self) -> Vec<f64> {
        let (rows, columns) = self.knots;
        let n = rows * columns;
        let mut k = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                let (i, j) = ((a / columns).abs_diff(b / columns), (a % columns).abs_diff(b % columns));
                k[a * n + b] = (-0.5 * (i * i + j * j) as f64).exp();
            }
        }
        k
    }

    /// The marginal likelihood (its logarithm) of the shape, its values at the knots being normal about zero with deviation `width`.
    pub fn evidence(&self, gg: &[f64], gr: &[f64], weight: f64, width: f64) -> f64 {
        log_marginal(&qr::cholesky(&self.covariance(), gr.len()), gg, gr, weight, width)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(knots: (usize, usize)) -> Group {
        let motion = Motion {
            coefficients: vec![1.0],
            weights: vec![1.0],
            position: None,
            rate: None,
            acceleration: None,
        };
        Group { variable: Variable::Rate(motion), columns: 0..knots.0 * knots.1, knots }
    }

    /// ln of the density of `r`, normal about zero with this covariance.
    fn log_normal(r: &[f64], covariance: &[f64]) -> f64 {
        let n = r.len();
        -0.5 * (qr::dot(&qr::solve_spd(covariance, n, r), r) + qr::log_determinant(covariance, n))
    }

    /// One residual per row of G, whose covariance is I with the shape left out and I + G K Gᵀ with it.
    #[test]
    fn the_evidence_of_a_shape_is_a_ratio_of_two_normal_densities() {
        let (group, m, n, width) = (group((2, 3)), 9, 6, 0.7);
        let g: Vec<f64> = (0..m * n).map(|i| ((i * i + 3 * i) as f64 * 0.37).sin()).collect();
        let r: Vec<f64> = (0..m).map(|i| (i as f64 * 1.7).cos() * 2.0).collect();
        let identity: Vec<f64> = (0..m * m).map(|i| if i / m == i % m { 1.0 } else { 0.0 }).collect();
        let (k, mut c) = (group.covariance(), identity.clone());
        for i in 0..m * m {
            for j in 0..n * n {
                let (a, b) = (j / n, j % n);
                c[i] += width * width * g[i / m * n + a] * k[a * n + b] * g[i % m * n + b];
            }
        }
        let expected = log_normal(&r, &c) - log_normal(&r, &identity);
        let gg: Vec<f64> =
            (0..n * n).map(|i| (0..m).map(|k| g[k * n + i / n] * g[k * n + i % n]).sum()).collect();
        let gr: Vec<f64> = (0..n).map(|a| (0..m).map(|k| g[k * n + a] * r[k]).sum()).collect();
        let found = group.evidence(&gg, &gr, 1.0, width);
        assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        // Where every square is worth a quarter, G and r count half.
        let quarter = |v: &[f64]| -> Vec<f64> { v.iter().map(|v| 0.25 * v).collect() };
        let weighted = group.evidence(&gg, &gr, 0.25, width);
        assert!((weighted - group.evidence(&quarter(&gg), &quarter(&gr), 1.0, width)).abs() < 1e-9);
    }

    /// What a residual does not need costs the more, the more it could have been.
    #[test]
    fn a_shape_that_explains_nothing_is_unlikely() {
        let group = group((1, 7));
        let gg: Vec<f64> = (0..49).map(|i| if i / 7 == i % 7 { 200.0 } else { 0.0 }).collect();
        let nothing = |width: f64| group.evidence(&gg, &[0.0; 7], 1.0, width);
        assert!(nothing(1.0) < -3.0 && nothing(10.0) < nothing(1.0) - 2.0);
    }
}
