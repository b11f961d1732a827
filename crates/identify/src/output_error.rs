//! Sparse output error: the choice of terms made in the metric of the simulated output.
//!
//! Around a model with coefficients θ₀ the simulated output is ŷ(θ) ≈ ŷ(θ₀) + J (θ − θ₀), where J holds
//! the sensitivities to *all* candidate coefficients, those of absent terms (θ₀ = 0) included. With
//! z = y − ŷ(θ₀) + J θ₀ the choice of terms is a linear regression z = J θ + e whose regressors come from
//! the simulation, free of measurement noise, and whose errors are the white noise of the sensor: the two
//! conditions that regressions on smoothed derivatives violate. Chosen terms are refitted in earnest
//! (multiple shooting, then whole records) and the problem is linearised again until nothing changes.

use std::sync::Arc;

use greybox_calibrate::{
    Data, Fit, FreeParameter, Limits, Point, Prior, Segment, SegmentRows, Segmentation, Setup, Work, qr,
};
use rayon::prelude::*;

use crate::choose::{Reduced, Roles};
use crate::correlation::{FEW, LONGEST, Lagged};
use crate::structure::{Signal, Structure};

/// Misfit, relative to a channel's spread, that counts as numerical: integration, rounding in the file.
pub(crate) const NUMERICAL: f64 = 1e-5;

/// A model under refinement.
#[derive(Debug, Clone)]
pub(crate) struct State {
    /// Which candidates are in.
    pub active: Vec<bool>,
    /// Coefficients of all candidates (zero outside).
    pub values: Vec<f64>,
    /// Values of the parameters outside the choice: those of the extras, then the dead times.
    pub extras: Vec<f64>,
}

/// The fit of the active terms.
#[derive(Debug, Clone)]
pub(crate) struct Refined {
    /// The model.
    pub state: State,
    /// Compiled with its data.
    pub setup: Setup,
    /// Segments of the last fit.
    pub level: Segmentation,
    /// The last fit.
    pub fit: Fit,
    /// Residual standard deviation per channel, SI.
    pub scale: Vec<f64>,
    /// Rounds of choice and refit.
    pub rounds: usize,
}

pub(crate) fn setup(
    structure: &Structure,
    data: &Arc<Data>,
    state: &State,
    base: Option<&Setup>,
) -> Option<Setup> {
    let model = structure.model(&state.active, &state.values, &state.extras).ok()?;
    let free = model
        .parameters
        .iter()
        .enumerate()
        .filter(|(_, p)| !p.fixed)
        .map(|(index, p)| {
            let leading = structure.terms.iter().any(|t| !t.optional && t.parameter == p.name);
            let dead_time = structure.dead_times.iter().find(|d| d.parameter == p.name);
            let (lower, upper) = match (leading, p.value >= 0.0) {
                (false, _) => dead_time.map_or((f64::NEG_INFINITY, f64::INFINITY), |d| (0.0, d.longest)),
                (true, true) => (0.02 * p.value, 50.0 * p.value),
                (true, false) => (50.0 * p.value, 0.02 * p.value),
            };
            FreeParameter { index, prior: Prior::Flat, lower, upper }
        })
        .collect();
    let holds: Vec<greybox_model::Hold> = model.inputs.iter().map(|i| i.hold).collect();
    match base {
        Some(base) if base.holds == holds => base.with_model(model, free).ok(),
        Some(base) => base.with_holds(holds).with_model(model, free).ok(),
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
    for ((name, _), v) in structure.outside().zip(&mut state.extras) {
        *v = value(name).unwrap_or(*v);
    }
}

/// Most rounds of choice and refit on segments of one length.
const ROUNDS: usize = 6;

/// The regression of the output on all candidates around a fitted model.
pub(crate) struct Linearised {
    /// The regression.
    pub reduced: Reduced,
    /// Column of each candidate (none: it has no coefficient, or is not allowed).
    pub column: Vec<Option<usize>>,
    /// Gram matrices of [J | z] over blocks of consecutive rows, `columns + 1` squared.
    pub blocks: Vec<Vec<f64>>,
}

impl Linearised {
    /// What the columns stand for.
    pub(crate) fn roles(&self, structure: &Structure, allowed: &[bool]) -> Roles {
        let mut columns = vec![None; self.reduced.columns];
        for (term, column) in self.column.iter().enumerate() {
            if let Some(c) = column {
                columns[*c] = Some(term);
            }
        }
        Roles::new(&columns, &structure.terms, allowed)
    }

    /// The regression on blocks drawn with replacement.
    pub(crate) fn resampled(&self, drawn: &[usize]) -> Reduced {
        let p = self.reduced.columns;
        let mut gram = vec![0.0; (p + 1) * (p + 1)];
        for &b in drawn {
            gram.iter_mut().zip(&self.blocks[b]).for_each(|(g, v)| *g += v);
        }
        let Reduced { samples, floor, .. } = self.reduced;
        Reduced::from_triangle(&cholesky(&gram, p + 1), p, samples, floor)
    }
}

/// Upper triangular Cholesky factor of a symmetric positive semidefinite matrix, scaled to a unit diagonal
/// first; a dependent column gets a zero row.
fn cholesky(a: &[f64], n: usize) -> Vec<f64> {
    let scale: Vec<f64> = (0..n).map(|i| a[i * n + i].max(0.0).sqrt()).collect();
    let mut r = vec![0.0; n * n];
    for i in 0..n {
        if scale[i] == 0.0 {
            continue;
        }
        for j in i..n {
            if scale[j] == 0.0 {
                continue;
            }
            let mut v = a[i * n + j] / (scale[i] * scale[j]);
            for k in 0..i {
                v -= r[k * n + i] * r[k * n + j];
            }
            if i == j {
                r[i * n + i] = if v > 1e-13 { v.sqrt() } else { 0.0 };
            } else if r[i * n + i] > 0.0 {
                r[i * n + j] = v / r[i * n + i];
            }
        }
    }
    for i in 0..n {
        for j in i..n {
            r[i * n + j] *= scale[j];
        }
    }
    r
}

/// One segment with what its start can absorb projected off.
pub(crate) struct Projected {
    /// Samples times channels.
    pub rows: usize,
    /// Sensitivities to the coefficients, a column each.
    pub j: Vec<f64>,
    /// Residual plus J θ₀.
    pub z: Vec<f64>,
}

/// The segments of a model, wide: with all candidates that it may have.
pub(crate) struct Wide {
    /// The model with all of them.
    pub setup: Setup,
    /// Its segments.
    pub segments: Vec<Projected>,
    /// Residual sum of squares per channel, scaled.
    pub rss: Vec<f64>,
    /// Number of values in it.
    pub count: Vec<usize>,
}

/// Column of each candidate among those of a model that has all `wanted` (none: it has no coefficient, or is not
/// wanted): coefficients stand in the order of the candidates, before what the extras have.
pub(crate) fn columns(structure: &Structure, wanted: &[bool]) -> Vec<Option<usize>> {
    let mut next = 0..;
    let has = |i: usize| wanted[i] && structure.has_coefficient(i);
    (0..wanted.len()).map(|i| if has(i) { next.next() } else { None }).collect()
}

/// Both, term by term.
pub(crate) fn either(active: &[bool], allowed: &[bool]) -> Vec<bool> {
    active.iter().zip(allowed).map(|(a, b)| *a || *b).collect()
}

/// The sensitivities of `refined` to all candidates in `allowed`, and what they are held against.
pub(crate) fn widen(structure: &Structure, refined: &Refined, allowed: &[bool]) -> Option<Wide> {
    let active = either(&refined.state.active, allowed);
    let wide = setup(
        structure,
        &refined.setup.data,
        &State { active, ..refined.state.clone() },
        Some(&refined.setup),
    )?;
    let point = Point { parameters: wide.values(), starts: refined.fit.point.starts.clone() };
    let (rows, (rss, count)) = wide.with_problem(&refined.level, &refined.scale, |p| {
        let rows = p.rows(&point, true, None);
        let sums = p.rss(&rows);
        (rows, sums)
    });
    let theta: Vec<f64> = wide.free.iter().map(|f| point.parameters[f.index]).collect();
    let segments: Vec<Projected> = rows
        .into_par_iter()
        .map(|s| {
            let SegmentRows { rows, jx, jp, r: mut z, .. } = s;
            let (q, j) = project_start(rows, jx, jp);
            qr::project_off(&q, rows, &mut z);
            for (column, theta) in j.chunks_exact(rows).zip(&theta) {
                z.iter_mut().zip(column).for_each(|(z, v)| *z += theta * v);
            }
            Projected { rows, j, z }
        })
        .collect();
    let finite = segments.iter().all(|s| s.z.iter().chain(&s.j).all(|v| v.is_finite()));
    finite.then_some(Wide { setup: wide, segments, rss, count })
}

/// The triangle of [J | z] over segments of `stride − 1` coefficients.
pub(crate) fn triangle_of(segments: &[Projected], stride: usize) -> Vec<f64> {
    let triangles: Vec<Vec<f64>> = segments
        .par_iter()
        .map(|s| {
            let mut a = Vec::with_capacity(stride * s.rows);
            a.extend_from_slice(&s.j);
            a.extend_from_slice(&s.z);
            qr::triangle(&mut a, s.rows, stride)
        })
        .collect();
    stack(&triangles, stride)
}

/// The triangle of all rows behind several triangles.
pub(crate) fn stack(triangles: &[Vec<f64>], stride: usize) -> Vec<f64> {
    let m = triangles.len() * stride;
    let mut a = vec![0.0; m * stride];
    for (s, t) in triangles.iter().enumerate() {
        for i in 0..stride {
            for j in i..stride {
                a[j * m + s * stride + i] = t[i * stride + j];
            }
        }
    }
    qr::triangle(&mut a, m, stride)
}

/// Mean square of whitened rows below which a misfit is numerical.
pub(crate) fn floor(spread: &[f64], scale: &[f64]) -> f64 {
    let squares = spread.iter().zip(scale).map(|(spread, scale)| (NUMERICAL * spread / scale).powi(2));
    squares.sum::<f64>() / spread.len() as f64
}

/// An orthonormal basis of what a segment's start can absorb, from `jx` in place, and `jp` with it projected
/// off; columns of `rows`.
pub(crate) fn project_start(rows: usize, mut jx: Vec<f64>, mut jp: Vec<f64>) -> (Vec<f64>, Vec<f64>) {
    let nx = jx.len() / rows;
    qr::orthonormalise(&mut jx, rows, nx);
    for column in jp.chunks_exact_mut(rows) {
        qr::project_off(&jx, rows, column);
    }
    (jx, jp)
}

/// Linearises around `refined` with all candidates in `allowed`; `blocks` asks for about as many block Grams.
pub(crate) fn linearise(
    structure: &Structure,
    refined: &Refined,
    allowed: &[bool],
    blocks: usize,
) -> Option<Linearised> {
    let wide = widen(structure, refined, allowed)?;
    let np = wide.setup.free.len();
    let t = triangle_of(&wide.segments, np + 1);
    let column = columns(structure, &either(&refined.state.active, allowed));
    let count: usize = refined.fit.count.iter().sum();
    let floor = floor(&refined.setup.data.spread, &refined.scale);
    let projected = &wide.segments;
    let reduced = Reduced::from_triangle(&t, np, count as f64, floor);
    // Correlated residuals: as many rows as are independent.
    let all: Vec<usize> = (0..np).collect();
    let best = reduced.solve(&all).values;
    let share = 1.0 / correlation_time(projected, &best, refined, wide.setup.system.ny);
    let reduced = reduced.weighted(share);
    let blocks = if blocks > 0 { block_grams(projected, np, share, blocks) } else { Vec::new() };
    Some(Linearised { reduced, column, blocks })
}

/// Correlation time of the residual with coefficients `theta`, the longest of the channels.
fn correlation_time(projected: &[Projected], theta: &[f64], refined: &Refined, ny: usize) -> f64 {
    let segments = &refined.level.segments;
    // Mostly a few lags tell.
    let few = lagged(projected, theta, segments, ny, FEW);
    let all =
        if few.iter().all(Lagged::is_enough) { few } else { lagged(projected, theta, segments, ny, LONGEST) };
    all.iter().map(Lagged::time).fold(1.0, f64::max)
}

/// Lagged products of the residual with coefficients `theta`, channel by channel.
pub(crate) fn lagged(
    projected: &[Projected],
    theta: &[f64],
    segments: &[Segment],
    ny: usize,
    lags: usize,
) -> Vec<Lagged> {
    let residuals: Vec<Vec<f64>> = projected
        .par_iter()
        .map(|s| {
            let mut e = s.z.clone();
            for (column, theta) in s.j.chunks_exact(s.rows).zip(theta) {
                e.iter_mut().zip(column).for_each(|(e, v)| *e -= theta * v);
            }
            e
        })
        .collect();
    let of_channel = |c: usize| {
        let stretches = residuals.iter().zip(segments).map(move |(e, segment)| {
            let m = segment.range.len();
            &e[c * m..(c + 1) * m]
        });
        Lagged::of(stretches, lags)
    };
    (0..ny).map(of_channel).collect()
}

fn block_grams(projected: &[Projected], np: usize, share: f64, blocks: usize) -> Vec<Vec<f64>> {
    let total: usize = projected.iter().map(|s| s.rows).sum();
    let length = total.div_ceil(blocks).max(1);
    projected
        .par_iter()
        .flat_map_iter(|s| {
            (0..s.rows).step_by(length).map(move |from| {
                let to = (from + length).min(s.rows);
                let column = |c: usize| -> &[f64] {
                    if c < np { &s.j[c * s.rows + from..c * s.rows + to] } else { &s.z[from..to] }
                };
                let mut gram = vec![0.0; (np + 1) * (np + 1)];
                for i in 0..=np {
                    for j in i..=np {
                        let v = share * qr::dot(column(i), column(j));
                        gram[i * (np + 1) + j] = v;
                        gram[j * (np + 1) + i] = v;
                    }
                }
                gram
            })
        })
        .collect()
}

impl Refined {
    /// −2 ln likelihood with Schwarz's penalty for every parameter; smaller is better.
    pub(crate) fn score(&self) -> f64 {
        let data = &self.setup.data;
        let total: f64 = self.fit.count.iter().sum::<usize>() as f64;
        let fit: f64 = (0..self.fit.rss.len())
            .map(|c| {
                let n = self.fit.count[c].max(1) as f64;
                let floor = (NUMERICAL * data.spread[c]).powi(2);
                n * (self.scale[c].powi(2) + floor).ln()
            })
            .sum();
        fit + self.setup.free.len() as f64 * total.max(2.0).ln()
    }

    fn after(mut self, structure: &Structure) -> Refined {
        for c in 0..self.scale.len() {
            let rms = (self.fit.rss[c] / self.fit.count[c].max(1) as f64).sqrt() * self.scale[c];
            self.scale[c] = rms.max(1e-9 * self.setup.data.spread[c]).max(f64::MIN_POSITIVE);
        }
        let (setup, fit) = (self.setup.clone(), self.fit.clone());
        read_back(structure, &mut self.state, &setup, &fit);
        self
    }

    /// Whether a channel's residual has grown beyond `factor` times what it was in `before`.
    fn worse(&self, before: &Refined, factor: f64) -> bool {
        let data = &self.setup.data;
        self.scale
            .iter()
            .zip(&before.scale)
            .zip(&data.spread)
            .any(|((now, then), spread)| now.is_nan() || *now > factor * then.max(NUMERICAL * spread))
    }
}

/// Numbers of segments of the successive levels; the history of a delayed state must not be cut, so that a model with
/// one starts with whole records. The past of a delayed input is known at every cut.
const LEVELS: [usize; 4] = [60, 15, 4, 1];

fn levels(structure: &Structure) -> &'static [usize] {
    if structure.extras.is_empty() { &LEVELS } else { &LEVELS[3..] }
}

/// About `count` segments; none begins where the past of an input is not in the recording.
pub(crate) fn level(structure: &Structure, setup: &Setup, count: usize) -> Segmentation {
    setup.level_after(count, structure.unknown_past())
}

/// Most steps of a first fit.
pub(crate) const FIRST_STEPS: usize = 15;

/// A first fit of `start` on short segments.
pub(crate) fn begin(structure: &Structure, data: &Arc<Data>, start: State, work: Work) -> Option<Refined> {
    let setup = Setup { work: Arc::new(work), ..setup(structure, data, &start, None)? };
    let level = level(structure, &setup, levels(structure)[0]);
    let scale: Vec<f64> = data.sigma.iter().zip(&data.spread).map(|(s, d)| s.max(1e-6 * d)).collect();
    let point = Point { parameters: setup.values(), starts: setup.starts(&level, &setup.values()) };
    let limits = Limits { iterations: FIRST_STEPS, tolerance: 1e-4 };
    let fit = setup.with_problem(&level, &scale, |p| p.fit(point, limits));
    fit.cost
        .is_finite()
        .then(|| Refined { state: start, setup, level, fit, scale, rounds: 0 }.after(structure))
}

/// The same terms fitted again under another structure (other holds).
pub(crate) fn refit(structure: &Structure, refined: &Refined) -> Option<Refined> {
    let next = setup(structure, &refined.setup.data, &refined.state, Some(&refined.setup))?;
    let point = Point { parameters: next.values(), starts: refined.fit.point.starts.clone() };
    let fit = next.with_problem(&refined.level, &refined.scale, |p| {
        p.fit(point, Limits { iterations: 20, tolerance: 1e-7 })
    });
    fit.cost.is_finite().then(|| Refined { setup: next, fit, ..refined.clone() }.after(structure))
}

/// Every equation divided by the strength of the first input that it has, which then stands on its right with factor
/// one and is no candidate any more; equations without an input stay divided by their leading coefficient.
pub(crate) fn scaled_by_inputs(
    structure: Structure,
    refined: Refined,
    allowed: &mut [bool],
) -> (Structure, Refined) {
    let mut scaled = structure.clone();
    let mut state = refined.state.clone();
    let mut moved = Vec::new();
    for (e, equation) in
        scaled.equations.iter_mut().enumerate().filter(|(_, e)| e.input.is_none() && e.normalised)
    {
        let of_equation = |i: usize| structure.terms[i].part(e).is_some();
        let Some((name, term)) = first_input(&structure, &state, e).filter(|i| state.values[i.1] != 0.0)
        else {
            continue;
        };
        let strength = -state.values[term];
        (equation.input, equation.normalised) = (Some(name.to_string()), false);
        state.active[term] = false;
        moved.push(term);
        (0..structure.terms.len()).filter(|i| of_equation(*i)).for_each(|i| state.values[i] /= strength);
        state.values[term] = 0.0;
    }
    if scaled.equations == structure.equations {
        return (structure, refined);
    }
    match refit(&scaled, &Refined { state, ..refined.clone() }) {
        Some(refined) => {
            moved.into_iter().for_each(|term| allowed[term] = false);
            (scaled, refined)
        }
        None => (structure, refined),
    }
}

/// The first input that is a chosen term of an equation, and the term.
fn first_input<'a>(structure: &'a Structure, state: &State, equation: usize) -> Option<(&'a str, usize)> {
    structure.inputs.iter().find_map(|(Signal { name, .. }, _)| {
        let acts = |i: &usize| state.active[*i] && structure.terms[*i].is(equation, name);
        Some((name.as_str(), (0..structure.terms.len()).find(acts)?))
    })
}

/// The fit with a parameter drawn to a value by a prior much narrower than any interval: from the optimum the others
/// and the starts follow it, where a whole record of a machine that magnifies small differences would be lost at once.
fn held_at(structure: &Structure, refined: &Refined, parameter: &str, value: f64) -> Refined {
    const WIDTH: f64 = 1e-7;
    let mut setup = refined.setup.clone();
    let index = setup.model.parameter(parameter);
    for free in setup.free.iter_mut().filter(|f| Some(f.index) == index) {
        free.prior = Prior::Normal { mean: value, std: WIDTH };
    }
    let limits = Limits { iterations: 30, tolerance: 1e-9 };
    let fit =
        setup.with_problem(&refined.level, &refined.scale, |p| p.fit(refined.fit.point.clone(), limits));
    Refined { setup, fit, ..refined.clone() }.after(structure)
}

/// Among equations with one scale: inputs whose strength may as well be one stand on the right.
pub(crate) fn with_inputs_of_strength_one(
    mut structure: Structure,
    mut refined: Refined,
    allowed: &mut [bool],
) -> (Structure, Refined) {
    for e in 0..structure.equations.len() {
        let equation = &structure.equations[e];
        if equation.input.is_some() || equation.normalised {
            continue;
        }
        let Some((name, term)) = first_input(&structure, &refined.state, e) else { continue };
        let mut simpler = structure.clone();
        simpler.equations[e].input = Some(name.to_string());
        let mut held = held_at(&structure, &refined, &structure.terms[term].parameter, -1.0);
        (held.state.active[term], held.state.values[term]) = (false, 0.0);
        if let Some(refit) = refit(&simpler, &held)
            && refit.score() < refined.score()
        {
            (structure, refined) = (simpler, refit);
            allowed[term] = false;
        }
    }
    (structure, refined)
}

fn fit_at(refined: &Refined, structure: &Structure, to: Segmentation, limits: Limits) -> Refined {
    let start = refined.setup.stitch(&refined.level, &refined.fit.point, &to, &refined.scale);
    let fit = refined.setup.with_problem(&to, &refined.scale, |p| p.fit(start, limits));
    Refined { level: to, fit, ..refined.clone() }.after(structure)
}

/// One round: linearise, choose, refit. None where the choice stays as it is or the new fit fails.
fn round(structure: &Structure, refined: &Refined, allowed: &[bool], seen: &[Vec<bool>]) -> Option<Refined> {
    let linear = linearise(structure, refined, allowed, 0)?;
    let solution = linear.reduced.choose(&linear.roles(structure, allowed));
    let mut state = refined.state.clone();
    for (i, term) in structure.terms.iter().enumerate() {
        if !term.optional {
            continue;
        }
        let at = linear.column[i].and_then(|c| solution.columns.iter().position(|s| *s == c));
        // New terms start where the regression puts them, old ones where they are.
        if let Some(at) = at
            && !state.active[i]
        {
            state.values[i] = solution.values[at];
        }
        state.active[i] = at.is_some();
    }
    if state.active == refined.state.active || seen.contains(&state.active) {
        return None;
    }
    let next = setup(structure, &refined.setup.data, &state, Some(&refined.setup))?;
    let point = Point { parameters: next.values(), starts: refined.fit.point.starts.clone() };
    let limits = Limits { iterations: 20, tolerance: 1e-6 };
    let fit = next.with_problem(&refined.level, &refined.scale, |p| p.fit(point, limits));
    if !fit.cost.is_finite() {
        return None;
    }
    Some(Refined { state, setup: next, fit, rounds: refined.rounds + 1, ..refined.clone() }.after(structure))
}

/// Refines a first fit, choosing among the candidates in `allowed`; segments grow until they are whole
/// records, or as long as a fit still follows.
pub(crate) fn refine(structure: &Structure, begun: Refined, allowed: &[bool]) -> Refined {
    let mut refined = begun;
    let spent = |refined: &Refined| refined.setup.work.is_spent();
    for &count in levels(structure) {
        if spent(&refined) {
            return refined;
        }
        let level = level(structure, &refined.setup, count);
        if level.segments != refined.level.segments {
            let longer = fit_at(&refined, structure, level, Limits { iterations: 25, tolerance: 1e-5 });
            if longer.worse(&refined, 1.5) {
                break;
            }
            refined = longer;
        }
        let mut seen = vec![refined.state.active.clone()];
        for _ in 0..ROUNDS {
            if spent(&refined) {
                return refined;
            }
            let Some(next) = round(structure, &refined, allowed, &seen) else { break };
            seen.push(next.state.active.clone());
            refined = next;
        }
    }
    let level = refined.level.clone();
    fit_at(&refined, structure, level, Limits { iterations: 30, tolerance: 1e-9 })
}
