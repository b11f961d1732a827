//! Sparse output error: the choice of terms made in the metric of the simulated output.
//!
//! Around a model with coefficients θ₀ the simulated output is ŷ(θ) ≈ ŷ(θ₀) + J (θ − θ₀), where J holds
//! the sensitivities to *all* candidate coefficients, those of absent terms (θ₀ = 0) included. With
//! z = y − ŷ(θ₀) + J θ₀ the choice of terms is a linear regression z = J θ + e whose regressors come from
//! the simulation, free of measurement noise, and whose errors are the white noise of the sensor: the two
//! conditions that regressions on smoothed derivatives violate. Chosen terms are refitted in earnest
//! (multiple shooting, then whole records) and the problem is linearised again until nothing changes.

use std::sync::Arc;

use greybox_calibrate::{Data, Fit, Free, Level, Limits, Point, Setup, qr};

use crate::choose::Reduced;
use crate::structure::Structure;

/// Misfit, relative to a channel's spread, that counts as numerical: integration, rounding in the file.
pub const NUMERICAL: f64 = 1e-5;

/// A model under refinement.
#[derive(Debug, Clone)]
pub struct State {
    /// Which candidates are in.
    pub active: Vec<bool>,
    /// Coefficients of all candidates (zero outside).
    pub values: Vec<f64>,
    /// Values of the extras' parameters.
    pub extras: Vec<f64>,
}

/// The fit of the active terms.
#[derive(Debug, Clone)]
pub struct Refined {
    /// The model.
    pub state: State,
    /// Compiled with its data.
    pub setup: Setup,
    /// Segments of the last fit.
    pub level: Level,
    /// The last fit.
    pub fit: Fit,
    /// Residual standard deviation per channel, SI.
    pub scale: Vec<f64>,
    /// Rounds of choice and refit.
    pub rounds: usize,
}

fn setup(structure: &Structure, data: &Arc<Data>, state: &State, base: Option<&Setup>) -> Option<Setup> {
    let model = structure.model(&state.active, &state.values, &state.extras).ok()?;
    let free = model
        .parameters
        .iter()
        .enumerate()
        .filter(|(_, p)| !p.fixed)
        .map(|(index, p)| {
            let leading = structure.terms.iter().any(|t| !t.optional && t.parameter == p.name);
            let (lower, upper) = match (leading, p.value >= 0.0) {
                (false, _) => (f64::NEG_INFINITY, f64::INFINITY),
                (true, true) => (0.02 * p.value, 50.0 * p.value),
                (true, false) => (50.0 * p.value, 0.02 * p.value),
            };
            Free { index, mean: p.value, std: f64::INFINITY, lower, upper }
        })
        .collect();
    match base {
        Some(base) => base.with_model(model, free).ok(),
        None => Setup::new(&model, data.clone(), free).ok(),
    }
}

fn read_back(structure: &Structure, state: &mut State, setup: &Setup, fit: &Fit) {
    let value = |name: &str| setup.model.parameter(name).map(|i| fit.point.parameters[i]);
    for (i, term) in structure.terms.iter().enumerate() {
        state.values[i] = match (state.active[i], structure.has_coefficient(i)) {
            (true, true) => value(&term.parameter).unwrap_or(0.0),
            (true, false) => 1.0,
            (false, _) => 0.0,
        };
    }
    for ((name, _, _), v) in structure.extras.iter().flat_map(|e| &e.parameters).zip(&mut state.extras) {
        *v = value(name).unwrap_or(*v);
    }
}

/// The regression of the output on all candidates around the fitted model.
struct Linearised {
    reduced: Reduced,
    /// Column of each candidate (None: it has no coefficient).
    column: Vec<Option<usize>>,
    extras: Vec<usize>,
}

fn linearise(
    structure: &Structure,
    data: &Arc<Data>,
    refined: &Refined,
    allowed: &[bool],
) -> Option<Linearised> {
    let wide_state = State {
        active: refined.state.active.iter().zip(allowed).map(|(a, b)| *a || *b).collect(),
        ..refined.state.clone()
    };
    let wide = setup(structure, data, &wide_state, Some(&refined.setup))?;
    let point = Point { parameters: wide.values(), starts: refined.fit.point.starts.clone() };
    let rows = wide.with_problem(&refined.level, &refined.scale, |p| p.rows(&point, true, None));
    let (nx, np) = (wide.system.nx, wide.free.len());
    let width = nx + np + 1;
    let stride = np + 1;
    use rayon::prelude::*;
    let triangles: Vec<Vec<f64>> = rows
        .par_iter()
        .map(|s| {
            let mut a = Vec::with_capacity(width * s.rows);
            a.extend_from_slice(&s.jx);
            a.extend_from_slice(&s.jp);
            a.extend_from_slice(&s.r);
            qr::triangle(&mut a, s.rows, width)
        })
        .collect();
    let m = triangles.len() * stride;
    let mut a = vec![0.0; m * stride];
    for (s, t) in triangles.iter().enumerate() {
        for i in 0..stride {
            for j in i..stride {
                a[j * m + s * stride + i] = t[(nx + i) * width + nx + j];
            }
        }
    }
    let t = qr::triangle(&mut a, m, stride);
    let mut r = vec![0.0; np * np];
    for i in 0..np {
        r[i * np..(i + 1) * np].copy_from_slice(&t[i * stride..i * stride + np]);
    }
    let theta: Vec<f64> = wide.free.iter().map(|f| point.parameters[f.index]).collect();
    let z: Vec<f64> = (0..np)
        .map(|i| t[i * stride + np] + (i..np).map(|j| r[i * np + j] * theta[j]).sum::<f64>())
        .collect();
    let corner = t[np * stride + np];
    let of = |name: &str| {
        wide.model.parameter(name).and_then(|i| wide.free.iter().position(|f| f.index == i))
    };
    let column = structure.terms.iter().map(|t| of(&t.parameter)).collect();
    let extras = structure.extras.iter().flat_map(|e| &e.parameters).filter_map(|p| of(&p.0)).collect();
    let count: usize = refined.fit.count.iter().sum();
    let floor = data
        .spread
        .iter()
        .zip(&refined.scale)
        .map(|(spread, scale)| (NUMERICAL * spread / scale).powi(2))
        .sum::<f64>()
        / data.spread.len() as f64;
    let samples = count as f64;
    Some(Linearised {
        reduced: Reduced { columns: np, r, z, rest: corner * corner, samples, floor },
        column,
        extras,
    })
}

fn fit_at(
    refined: &mut Refined,
    structure: &Structure,
    to: Level,
    limits: Limits,
) {
    let start = refined.setup.stitch(&refined.level, &refined.fit.point, &to, &refined.scale);
    let fit = refined.setup.with_problem(&to, &refined.scale, |p| p.fit(start, limits));
    refined.level = to;
    refined.fit = fit;
    rescale(refined);
    let setup = refined.setup.clone();
    let fit = refined.fit.clone();
    read_back(structure, &mut refined.state, &setup, &fit);
}

fn rescale(refined: &mut Refined) {
    for c in 0..refined.scale.len() {
        let rms = (refined.fit.rss[c] / refined.fit.count[c].max(1) as f64).sqrt() * refined.scale[c];
        let least = 1e-9 * refined.setup.data.spread[c];
        refined.scale[c] = rms.max(least).max(f64::MIN_POSITIVE);
    }
}

/// Numbers of segments of the successive levels.
const LEVELS: [usize; 3] = [60, 15, 4];

/// Refines `start` on `data`, choosing among the candidates in `allowed`.
pub fn refine(structure: &Structure, data: &Arc<Data>, start: State, allowed: &[bool]) -> Option<Refined> {
    let setup0 = setup(structure, data, &start, None)?;
    let level = setup0.level(LEVELS[0]);
    let scale: Vec<f64> = data.sigma.iter().zip(&data.spread).map(|(s, d)| s.max(1e-6 * d)).collect();
    let point = Point { parameters: setup0.values(), starts: setup0.starts(&level, &setup0.values()) };
    let limits = Limits { iterations: 15, tolerance: 1e-4 };
    let fit = setup0.with_problem(&level, &scale, |p| p.fit(point, limits));
    let mut refined = Refined { state: start, setup: setup0, level, fit, scale, rounds: 0 };
    rescale(&mut refined);
    {
        let (s, f) = (refined.setup.clone(), refined.fit.clone());
        read_back(structure, &mut refined.state, &s, &f);
    }
    for count in LEVELS.into_iter().chain([1]) {
        let level = refined.setup.level(count);
        if level.segments != refined.level.segments {
            fit_at(&mut refined, structure, level, Limits { iterations: 20, tolerance: 1e-5 });
        }
        let mut seen: Vec<Vec<bool>> = Vec::new();
        for _ in 0..6 {
            let linear = linearise(structure, data, &refined, allowed)?;
            let kept: Vec<usize> = structure
                .terms
                .iter()
                .zip(&linear.column)
                .filter(|(t, _)| !t.optional)
                .filter_map(|(_, c)| *c)
                .chain(linear.extras.iter().copied())
                .collect();
            let optional: Vec<usize> = structure
                .terms
                .iter()
                .zip(&linear.column)
                .zip(allowed)
                .filter(|((t, _), ok)| t.optional && **ok)
                .filter_map(|((_, c), _)| *c)
                .collect();
            let even: Vec<usize> =
                structure.terms.iter().zip(&linear.column).filter(|(t, _)| t.even).filter_map(|(_, c)| *c).collect();
            let solution = linear.reduced.choose(&kept, &optional, &even);
            let mut state = refined.state.clone();
            for (i, term) in structure.terms.iter().enumerate() {
                if term.optional {
                    state.active[i] = linear.column[i].is_some_and(|c| solution.columns.contains(&c));
                }
            }
            if state.active == refined.state.active || seen.contains(&state.active) {
                break;
            }
            seen.push(refined.state.active.clone());
            for (i, c) in linear.column.iter().enumerate() {
                let at = c.and_then(|c| solution.columns.iter().position(|s| *s == c));
                if let Some(at) = at {
                    // New terms start where the regression puts them, old ones where they are.
                    if !refined.state.active[i] {
                        state.values[i] = solution.values[at];
                    }
                }
            }
            let next = setup(structure, data, &state, Some(&refined.setup))?;
            let point = Point { parameters: next.values(), starts: refined.fit.point.starts.clone() };
            let fit = next.with_problem(&refined.level, &refined.scale, |p| {
                p.fit(point, Limits { iterations: 20, tolerance: 1e-6 })
            });
            refined = Refined { state, setup: next, fit, rounds: refined.rounds + 1, ..refined };
            rescale(&mut refined);
            let (s, f) = (refined.setup.clone(), refined.fit.clone());
            read_back(structure, &mut refined.state, &s, &f);
        }
    }
    let level = refined.level.clone();
    fit_at(&mut refined, structure, level, Limits { iterations: 30, tolerance: 1e-9 });
    Some(refined)
}
