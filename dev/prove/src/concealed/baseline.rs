//! The baseline method: what one would script with a sparse-regression library in an afternoon.
//!
//! The calibrated model (greybox's own calibration, which is generous), accelerations by Savitzky–Golay
//! derivatives of the measurements, the force that the equations then miss, and STLSQ (Brunton, Proctor &
//! Kutz 2016) of it on polynomials up to degree 3 of states and inputs and on the sign of the velocity. The
//! threshold is the one that predicts the last fifth of the recording best; something is missing where that
//! prediction takes more than a tenth of the missing force's variance, and where the force is not small beside
//! that of inertia (derivatives of smoothed measurements err in proportion to it).
//!
//! It does not simulate what it finds: held-out errors are not defined for it. A state that no channel
//! measures is beyond it as well.

use greybox_sparse::stlsq::{Threshold, stlsq_path};
use greybox_sparse::{Rows, Triangle};
use serde::Serialize;

use super::case::Case;
use greybox_plants::excite::rms;
use greybox_plants::machine::Family;

/// Share of the validation variance below which nothing is said to be missing.
const PREDICTED: f64 = 0.1;

/// Missing force over the force of inertia (RMS) below which nothing is said to be missing.
const NOTICED: f64 = 0.05;

/// What the baseline says.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct Verdict {
    pub(crate) detected: bool,
    /// The kind of its largest term; absent where that term is of no kind.
    pub(crate) kind: Option<&'static str>,
    /// The equation it is in.
    pub(crate) equation: Option<String>,
    /// All terms kept.
    pub(crate) terms: Vec<String>,
}

/// Judges a case; `None` where a state is not measured.
pub(crate) fn judge(case: &Case, calibrated: &[f64]) -> Option<Verdict> {
    let family = case.machine.family;
    if family == Family::DcMotor || case.measured.contains(&false) {
        return None;
    }
    let n = family.coordinates();
    let mut machine = case.machine.clone();
    machine.effects.clear();
    machine.p.iter_mut().zip(calibrated).for_each(|(p, &c)| *p = if *p == 0.0 { 0.0 } else { c });
    // States, rates and missing forces of all training recordings.
    let empty = || vec![Vec::new(); n];
    let (mut q, mut v, mut missing, mut inertia) = (empty(), empty(), empty(), empty());
    let mut u = vec![Vec::new(); family.inputs()];
    for recording in &case.recordings[..case.recordings.len() - 1] {
        let smooth: Vec<[Vec<f64>; 3]> = recording.shown.iter().map(|y| derivatives(y, case.dt)).collect();
        // Each window leaves out as much at both ends; the widest decides.
        let all = recording.shown[0].len();
        let edges: Vec<usize> = smooth.iter().map(|s| (all - s[0].len()) / 2).collect();
        let edge = edges.iter().copied().max().unwrap_or(0);
        for k in edge..all - edge {
            let of = |c: usize, order: usize| smooth.get(c).map_or(0.0, |s| s[order][k - edges[c]]);
            let at = |order: usize| [of(0, order), of(1, order)];
            let now: Vec<f64> = recording.run.u.iter().map(|u| u[k]).collect();
            let force = machine.missing_force(at(0), at(1), at(2), &now);
            let still = machine.missing_force(at(0), at(1), [0.0; 2], &now);
            for c in 0..n {
                q[c].push(at(0)[c]);
                v[c].push(at(1)[c]);
                missing[c].push(force[c]);
                inertia[c].push(force[c] - still[c]);
            }
            now.iter().zip(&mut u).for_each(|(x, u)| u.push(*x));
        }
    }
    let names = Names::of(family);
    let variables: Vec<&Vec<f64>> = q.iter().chain(&v).chain(&u).collect();
    let mut best = Verdict::default();
    let mut strongest = PREDICTED;
    for c in 0..n {
        let (columns, terms) = library(&variables, &names, &v);
        if let Some((gain, kept)) = regress(&columns, &missing[c]) {
            let part = rms(&missing[c]) / rms(&inertia[c]) * gain.max(0.0).sqrt();
            if gain <= strongest || part < NOTICED {
                continue;
            }
            strongest = gain;
            best = Verdict {
                detected: true,
                kind: kept.first().and_then(|&(i, _)| terms[i].kind(c, n)),
                equation: Some(family.equation_names()[c].to_owned()),
                terms: kept.iter().map(|&(i, x)| format!("{x:.3e} {}", terms[i].text(&names))).collect(),
            };
        }
    }
    Some(best)
}

/// Names of the variables: coordinates, rates, inputs.
struct Names(Vec<String>);

impl Names {
    fn of(family: Family) -> Names {
        let states = family.states().iter().map(|s| s.0.to_owned());
        let rates = family.states().iter().map(|s| format!("{}'", s.0));
        let inputs = family.input_names().iter().map(|s| s.0.to_owned());
        Names(states.chain(rates).chain(inputs).collect())
    }
}

/// A column of the library.
enum Term {
    /// Powers of the variables.
    Product(Vec<usize>),
    /// Sign of the rate of a coordinate.
    Sign(usize),
}

impl Term {
    fn text(&self, names: &Names) -> String {
        match self {
            Term::Product(of) if of.is_empty() => "1".into(),
            Term::Product(of) => of.iter().map(|&i| names.0[i].as_str()).collect::<Vec<_>>().join("*"),
            Term::Sign(c) => format!("sign({}')", names.0[*c]),
        }
    }

    /// The kind that a term in the equation of coordinate `c` of `n` speaks for.
    fn kind(&self, c: usize, n: usize) -> Option<&'static str> {
        let (own, rate) = (c, n + c);
        match self {
            Term::Sign(_) => Some("coulomb_friction"),
            Term::Product(of) => match of[..] {
                [] => Some("constant_offset"),
                [a] if a == own => Some("linear_stiffness"),
                [a] if a == rate => Some("viscous_friction"),
                [a] if a < 2 * n => Some("coupling"),
                [a, b] if a == own && b == own => Some("quadratic_stiffness"),
                [a, b, d] if [a, b, d] == [own; 3] => Some("cubic_stiffness"),
                [a, b, d] if [a, b, d] == [rate; 3] => Some("quadratic_drag"),
                [a, b, d] if a >= 2 * n && a == b && b == d => Some("input_saturation"),
                _ => None,
            },
        }
    }
}

/// Monomials up to degree 3 and the signs of the rates.
fn library(variables: &[&Vec<f64>], names: &Names, rates: &[Vec<f64>]) -> (Vec<Vec<f64>>, Vec<Term>) {
    let m = names.0.len();
    let mut products: Vec<Vec<usize>> = vec![vec![]];
    for a in 0..m {
        products.push(vec![a]);
        for b in a..m {
            products.push(vec![a, b]);
            products.extend((b..m).map(|d| vec![a, b, d]));
        }
    }
    let length = variables[0].len();
    let mut columns: Vec<Vec<f64>> = products
        .iter()
        .map(|of| (0..length).map(|k| of.iter().map(|&i| variables[i][k]).product()).collect())
        .collect();
    let mut terms: Vec<Term> = products.into_iter().map(Term::Product).collect();
    for (c, rate) in rates.iter().enumerate() {
        columns.push(rate.iter().map(|v| v.signum()).collect());
        terms.push(Term::Sign(c));
    }
    (columns, terms)
}

/// STLSQ with the threshold that predicts the last fifth best: the share of the variance it predicts there,
/// and the columns kept, largest contribution first. `None` where there is nothing to regress.
fn regress(columns: &[Vec<f64>], target: &[f64]) -> Option<(f64, Vec<(usize, f64)>)> {
    // Every tenth sample: neighbours say the same.
    let thin =
        |x: &[f64], from: usize, to: usize| -> Vec<f64> { x[from..to].iter().step_by(10).copied().collect() };
    let (length, cut) = (target.len(), target.len() * 4 / 5);
    let size: Vec<f64> = columns.iter().map(|c| rms(&c[..cut])).collect();
    let scaled = |from: usize, to: usize| -> Vec<Vec<f64>> {
        columns
            .iter()
            .zip(&size)
            .map(|(c, s)| thin(c, from, to).iter().map(|x| x / s.max(1e-300)).collect())
            .collect()
    };
    let (train, target_train) = (scaled(0, cut), thin(target, 0, cut));
    let rows = Rows::new(&train.iter().collect::<Vec<_>>(), &target_train).ok()?;
    let whole = 0..target_train.len();
    let triangle = Triangle::of_rows(&rows, std::slice::from_ref(&whole)).ok()?;
    let thresholds = [0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7];
    let path = stlsq_path(&triangle, &[], &thresholds, Threshold::Normalised).ok()?;
    let (test, target_test) = (scaled(cut, length), thin(target, cut, length));
    let base: f64 = target_test.iter().map(|x| x * x).sum();
    let gain = |coefficients: &[f64]| {
        let left = (0..target_test.len()).map(|k| {
            let said: f64 = coefficients.iter().zip(&test).map(|(c, column)| c * column[k]).sum();
            (target_test[k] - said).powi(2)
        });
        1.0 - left.sum::<f64>() / base
    };
    let (gain, coefficients) = path
        .iter()
        .map(|fit| (gain(&fit.coefficients), &fit.coefficients))
        .max_by(|a, b| a.0.total_cmp(&b.0))?;
    let mut kept: Vec<(usize, f64)> =
        coefficients.iter().copied().enumerate().filter(|(_, x)| *x != 0.0).collect();
    kept.sort_by(|a, b| b.1.abs().total_cmp(&a.1.abs()));
    Some((gain, kept.into_iter().map(|(i, x)| (i, x / size[i])).collect()))
}

/// Value, first and second derivative by a local cubic over a window (Savitzky & Golay 1964) that grows
/// until it begins to take more than noise away; the edges are left out.
fn derivatives(y: &[f64], dt: f64) -> [Vec<f64>; 3] {
    // Noise from fourth differences: their variance is 70 times that of white noise.
    let fourth: Vec<f64> = y.windows(5).map(|w| w[0] - 4.0 * w[1] + 6.0 * w[2] - 4.0 * w[3] + w[4]).collect();
    let sigma = rms(&fourth) / 70f64.sqrt();
    let mut best = smooth(y, 3, dt);
    for half in [5, 8, 12, 20, 30, 45] {
        if 4 * half >= y.len() {
            break;
        }
        let tried = smooth(y, half, dt);
        let off: Vec<f64> = tried[0].iter().zip(&y[half..]).map(|(s, y)| y - s).collect();
        if rms(&off) > 1.15 * sigma * (1.0 - 2.25 / (2 * half + 1) as f64).sqrt() {
            break;
        }
        best = tried;
    }
    best
}

fn smooth(y: &[f64], half: usize, dt: f64) -> [Vec<f64>; 3] {
    let m = half as i64;
    let moment = |power: i32| (-m..=m).map(|i| (i as f64).powi(power)).sum::<f64>();
    let (s0, s2, s4, s6) = (moment(0), moment(2), moment(4), moment(6));
    // Normal equations of a cubic in the index split into even and odd powers.
    let (even, odd) = (s0 * s4 - s2 * s2, s2 * s6 - s4 * s4);
    let mut out = [Vec::new(), Vec::new(), Vec::new()];
    for window in y.windows(2 * half + 1) {
        let sum = |power: i32| (-m..=m).zip(window).map(|(i, y)| (i as f64).powi(power) * y).sum::<f64>();
        let (t0, t1, t2, t3) = (sum(0), sum(1), sum(2), sum(3));
        out[0].push((s4 * t0 - s2 * t2) / even);
        out[1].push((s6 * t1 - s4 * t3) / odd / dt);
        out[2].push(2.0 * (s0 * t2 - s2 * t0) / even / (dt * dt));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_differentiated_exactly() {
        let dt = 0.1;
        let y: Vec<f64> =
            (0..40).map(|k| k as f64 * dt).map(|t| 1.0 + 2.0 * t - t * t + 0.5 * t.powi(3)).collect();
        let [value, rate, bend] = smooth(&y, 4, dt);
        for k in 0..value.len() {
            let t = (k + 4) as f64 * dt;
            assert!((value[k] - y[k + 4]).abs() < 1e-12);
            assert!((rate[k] - (2.0 - 2.0 * t + 1.5 * t * t)).abs() < 1e-9);
            assert!((bend[k] - (-2.0 + 3.0 * t)).abs() < 1e-8);
        }
    }

    #[test]
    fn the_right_terms_are_kept() {
        let x: Vec<f64> =
            (0..2000).map(|k| (0.013 * f64::from(k)).sin() + 0.3 * (0.05 * f64::from(k)).cos()).collect();
        let v: Vec<f64> = (0..2000).map(|k| (0.029 * f64::from(k)).cos()).collect();
        let target: Vec<f64> = x.iter().zip(&v).map(|(x, v)| 3.0 * x.powi(3) + 0.7 * v.signum()).collect();
        let names = Names(vec!["x".into(), "x'".into()]);
        let rates = [v.clone()];
        let (columns, terms) = library(&[&x, &v], &names, &rates);
        let (gain, kept) = regress(&columns, &target).unwrap();
        assert!(gain > 0.999, "{gain}");
        let said: Vec<String> = kept.iter().map(|&(i, _)| terms[i].text(&names)).collect();
        assert_eq!(said, ["x*x*x", "sign(x')"]);
        assert!((kept[0].1 - 3.0).abs() < 1e-6 && (kept[1].1 - 0.7).abs() < 1e-6);
        assert_eq!(terms[kept[0].0].kind(0, 1), Some("cubic_stiffness"));
    }
}
