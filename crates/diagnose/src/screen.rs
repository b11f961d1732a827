//! The score test: what every candidate would explain, to first order, at the cost of one lane of the
//! sensitivity integration each.
//!
//! A candidate force c·φ(x̂(t)) is evaluated along the smoothed states (beside coloured noise, along
//! the fit's own trajectory) and injected as an exogenous force; its output response g, the residual r and the sensitivities J of the parameters
//! already in the model are projected off the segments' free initial states. With everything else
//! refitted to first order,
//!
//! ```text
//! c = (GᵀPG)⁻¹ GᵀPr,    gain = cᵀGᵀPG c / rᵀPr,    P = I − J(JᵀJ + Λ)⁻¹Jᵀ
//! ```
//!
//! (a Lagrange-multiplier test; Λ is the prior's precision). Working in output space, it neither
//! differentiates measurements nor suffers from the bias of a wrong nominal parameter.

use std::ops::Range;
use std::sync::Arc;

use greybox_calibrate::{FreeParameter, Point, SegmentRows, Segmentation, Setup, qr};
use greybox_model::{Equation, Expr, Hold, Input, Measurement, Model, Parameter, State, System, Unit};
use greybox_simulate::{Environment, Method, Seeds, Signal, SignalLanes, integrate};
use rayon::prelude::*;

use crate::candidate::Candidate;
use crate::library::{Mechanism, Scale};
use crate::place::Place;
use crate::shapes::evidence;
use crate::spectra::Spectra;
use crate::trajectory::TrajectoryEval;

/// One candidate with one choice of its inner parameters, as columns of the regression.
pub struct Variant {
    /// Index of the candidate.
    pub candidate: usize,
    /// Values of the inner parameters.
    pub inner: Vec<f64>,
    /// Sizes of the inner parameters.
    pub scales: Vec<f64>,
    /// Columns.
    pub columns: Range<usize>,
    /// The single column is the whole change (an input transformed), its coefficient 1 when the inner
    /// values are right; `Some(true)` when the coefficient may rescale the inner value.
    pub finite_difference: Option<bool>,
}

impl Variant {
    /// The inner parameters times a factor, as far as their bounds let them go.
    fn scaled(&self, mechanism: &Mechanism, factor: f64) -> Vec<f64> {
        let bounds = mechanism.inner.iter().zip(&self.scales).map(|(inner, scale)| inner.bounds(scale.abs()));
        self.inner.iter().zip(bounds).map(|(v, (low, high))| (v * factor).max(low).min(high)).collect()
    }
}

/// Share of a column's sum of squares that the model's own parameters must leave over: a column with less is
/// collinear with a parameter, and its coefficient would be rounding.
const INDEPENDENT: f64 = 3e-4;

/// What the score test says of a candidate's best variant.
#[derive(Debug, Clone)]
pub struct Scored {
    /// Index of the candidate.
    pub candidate: usize,
    /// Share of the residual sum of squares explained, to first order.
    pub gain: f64,
    /// First values of the parameters, linear ones first.
    pub values: Vec<f64>,
    /// First-order shift of the free parameters that goes with them.
    pub shift: Vec<f64>,
    /// Sizes of the inner parameters.
    pub scales: Vec<f64>,
    /// A tenth of the effect, from where a fit can go on when the first order promised too much.
    pub reduced_start: Option<Vec<f64>>,
    /// The next best choices of the inner parameters: (gain, values, shift).
    pub others: Vec<(f64, Vec<f64>, Vec<f64>)>,
}

/// What one column of the regression does to the machine, or a part of it.
#[derive(Debug, Clone)]
pub enum Component {
    /// A force with weights on the equations.
    Force(Vec<f64>, Vec<Vec<f64>>),
    /// A change of an input.
    Input(usize, Vec<Vec<f64>>),
    /// A change of a measurement.
    Output(usize, Vec<Vec<f64>>),
}

/// Exogenous signals of a set of candidates.
pub struct CandidateResponses {
    /// Per piece.
    pub signals: Vec<Arc<SignalLanes>>,
    /// Each column is the sum of these lanes.
    pub columns: Vec<Range<usize>>,
    /// The variants behind the columns.
    pub variants: Vec<Variant>,
}

/// Sizes read off the data for a mechanism's inner parameters at a place.
pub fn inner_scales(
    mechanism: &Mechanism,
    candidate: &Candidate,
    along: &TrajectoryEval<'_>,
    setup: &Setup,
) -> Option<Vec<f64>> {
    let keep = |n: &str| n.to_string();
    let duration = || setup.data.pieces.iter().map(|p| p.len as f64 * p.dt).fold(0.0, f64::max);
    mechanism
        .inner
        .iter()
        .map(|inner| {
            let series = |e| -> Option<Vec<f64>> {
                let e = candidate.translate(&setup.model, e, &keep);
                Some(along.eval(&[e], &[])?.pop()?.concat())
            };
            let range = |e| -> Option<f64> {
                let v = series(e)?;
                Some(
                    v.iter().fold(f64::NEG_INFINITY, |m, x| m.max(*x))
                        - v.iter().fold(f64::INFINITY, |m, x| m.min(*x)),
                )
            };
            let size = match &inner.scale {
                Scale::One => 1.0,
                Scale::Step => setup.data.pieces.iter().map(|p| p.dt).fold(0.0, f64::max),
                Scale::Duration => duration(),
                Scale::PerDuration => 1.0 / duration(),
                Scale::Rms(e) => {
                    let v = series(e)?;
                    (v.iter().map(|x| x * x).sum::<f64>() / v.len().max(1) as f64).sqrt()
                }
                Scale::Max(e) => series(e)?.iter().fold(0.0f64, |m, x| m.max(x.abs())),
                Scale::Top(e) => series(e)?.iter().fold(f64::NEG_INFINITY, |m, x| m.max(*x)),
                Scale::Frequency(e) => {
                    let e = candidate.translate(&setup.model, e, &keep);
                    let rate = e.time_derivative(&|n| setup.model.state(n).is_some()).simplify();
                    let mut both = along.eval(&[e, rate], &[])?;
                    let (rate, value) = (both.pop()?.concat(), both.pop()?.concat());
                    let mean = value.iter().sum::<f64>() / value.len().max(1) as f64;
                    let swing: f64 = value.iter().map(|v| (v - mean).powi(2)).sum();
                    (rate.iter().map(|v| v * v).sum::<f64>() / swing).sqrt()
                }
                Scale::Range(e) => range(e)?,
                Scale::PerRange(e) => 1.0 / range(e)?,
            };
            (size.is_finite() && size > 0.0).then_some(size)
        })
        .collect()
}

/// Builds the lanes of all candidates along given states; `spectra` proposes angular frequencies.
pub fn lanes(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    along: &TrajectoryEval<'_>,
    spectra: &Spectra<'_>,
) -> CandidateResponses {
    let made: Vec<Vec<(Variant, Vec<Vec<Component>>)>> = candidates
        .par_iter()
        .enumerate()
        .map(|(index, candidate)| {
            let mechanism = &library[candidate.mechanism];
            variants(setup, mechanism, candidate, index, along, spectra)
        })
        .collect();
    let mut components: Vec<Component> = Vec::new();
    let mut columns = Vec::new();
    let mut variants = Vec::new();
    for (mut variant, parts) in made.into_iter().flatten() {
        let from = columns.len();
        for column in parts {
            let first = components.len();
            components.extend(column);
            columns.push(first..components.len());
        }
        variant.columns = from..columns.len();
        variants.push(variant);
    }
    CandidateResponses { signals: signals(setup, &components), columns, variants }
}

/// What a simulation adds, one lane for each component; per piece.
pub fn signals(setup: &Setup, components: &[Component]) -> Vec<Arc<SignalLanes>> {
    let (count, nz) = (components.len(), setup.system.nz);
    setup
        .data
        .pieces
        .iter()
        .enumerate()
        .map(|(p, piece)| {
            let mut lanes = SignalLanes {
                lanes: count,
                weights: vec![0.0; nz * count],
                force: vec![0.0; piece.len * count],
                ..SignalLanes::default()
            };
            let put = |tables: &mut Vec<(usize, Vec<f64>)>, of: usize, l: usize, series: &[f64]| {
                let at = tables.iter().position(|t| t.0 == of).unwrap_or_else(|| {
                    tables.push((of, vec![0.0; piece.len * count]));
                    tables.len() - 1
                });
                for (k, v) in series.iter().enumerate() {
                    tables[at].1[k * count + l] = if v.is_finite() { *v } else { 0.0 };
                }
            };
            for (l, component) in components.iter().enumerate() {
                match component {
                    Component::Force(weights, series) => {
                        for (e, w) in weights.iter().enumerate() {
                            lanes.weights[e * count + l] = *w;
                        }
                        for (k, v) in series[p].iter().enumerate() {
                            lanes.force[k * count + l] = if v.is_finite() { *v } else { 0.0 };
                        }
                    }
                    Component::Input(i, series) => put(&mut lanes.inputs, *i, l, &series[p]),
                    Component::Output(c, series) => put(&mut lanes.outputs, *c, l, &series[p]),
                }
            }
            Arc::new(lanes)
        })
        .collect()
}

/// What a law does along given states at these values of its own parameters.
pub fn effect(
    setup: &Setup,
    mechanism: &Mechanism,
    candidate: &Candidate,
    along: &TrajectoryEval<'_>,
    values: &[f64],
) -> Option<Vec<Component>> {
    Law::new(setup, mechanism, candidate, along)?.components(values)
}

/// The columns of a candidate for every choice of its inner parameters.
fn variants(
    setup: &Setup,
    mechanism: &Mechanism,
    candidate: &Candidate,
    index: usize,
    along: &TrajectoryEval<'_>,
    spectra: &Spectra<'_>,
) -> Vec<(Variant, Vec<Vec<Component>>)> {
    let mut out = Vec::new();
    let Some(scales) = inner_scales(mechanism, candidate, along, setup) else { return out };
    if mechanism.reversals > 0 && reversals(candidate, along) < mechanism.reversals {
        return out;
    }
    let Some(law) = Law::new(setup, mechanism, candidate, along) else { return out };
    for inner in grid(mechanism, candidate, &scales, spectra) {
        let count = mechanism.linear.len();
        let column = |linear: &[f64], inner: &[f64]| law.components(&mechanism.values(linear, inner)?);
        let mut finite_difference = None;
        let columns: Option<Vec<Vec<Component>>> = if count == 0 {
            let whole = column(&[], &inner);
            let size = |c: &Option<Vec<Component>>| c.as_deref().map_or(0.0, largest);
            let tiny: Vec<f64> = inner.iter().map(|v| v * 1e-6).collect();
            let vanishes = inner.len() == 1
                && (!mechanism.states.is_empty() || size(&column(&[], &tiny)) < 1e-3 * size(&whole));
            if size(&whole) == 0.0 {
                continue;
            }
            finite_difference = Some(vanishes);
            whole.map(|c| vec![c])
        } else {
            (0..count)
                .map(|i| {
                    let unit: Vec<f64> = (0..count).map(|j| f64::from(u8::from(i == j))).collect();
                    column(&unit, &inner)
                })
                .collect()
        };
        let Some(columns) = columns else { continue };
        let variant =
            Variant { candidate: index, inner, scales: scales.clone(), columns: 0..0, finite_difference };
        out.push((variant, columns));
    }
    out
}

/// How often the motion turns round, small tremors not counted.
fn reversals(candidate: &Candidate, along: &TrajectoryEval<'_>) -> usize {
    let rate = candidate.motion().and_then(|m| m.rate.clone());
    let Some(rate) = rate.and_then(|e| along.eval(&[e], &[])?.pop()) else { return 0 };
    let n = rate.iter().map(Vec::len).sum::<usize>().max(1) as f64;
    let rms = (rate.iter().flatten().map(|v| v * v).sum::<f64>() / n).sqrt();
    rate.iter()
        .map(|piece| {
            let (mut sign, mut count) = (0.0, 0);
            for v in piece.iter().filter(|v| v.abs() > 0.1 * rms) {
                count += usize::from(sign * v < 0.0);
                sign = v.signum();
            }
            count
        })
        .sum()
}

fn largest(components: &[Component]) -> f64 {
    components
        .iter()
        .flat_map(|c| match c {
            Component::Force(_, s) | Component::Input(_, s) | Component::Output(_, s) => s.iter().flatten(),
        })
        .fold(0.0f64, |m, v| m.max(v.abs()))
}

/// A mechanism's law along given states, for any values of its parameters.
struct Law<'a> {
    setup: &'a Setup,
    mechanism: &'a Mechanism,
    candidate: &'a Candidate,
    along: &'a TrajectoryEval<'a>,
    /// The law less what it stands in for, the reaction; parameters marked.
    change: Vec<Expr>,
    marked: Vec<String>,
    memory: Option<MechanismSimulator>,
    /// For a parameter: derivative of each equation's residual, along the states.
    slopes: Vec<(usize, Vec<Vec<f64>>)>,
}

impl<'a> Law<'a> {
    fn new(
        setup: &'a Setup,
        mechanism: &'a Mechanism,
        candidate: &'a Candidate,
        along: &'a TrajectoryEval<'a>,
    ) -> Option<Law<'a>> {
        let model = &setup.model;
        // The file's own names may also be names of the model: mark them.
        let own =
            |n: &str| mechanism.parameters().any(|p| p == n) || mechanism.states.iter().any(|s| s.name == n);
        let rename = |n: &str| if own(n) { format!("mechanism#{n}") } else { n.to_string() };
        let mut change = vec![candidate.translate(model, &mechanism.law, &rename) - candidate.base(model)];
        if let Some(reaction) = &mechanism.reaction {
            change.push(candidate.translate(model, reaction, &rename));
        }
        let marked = mechanism.parameters().map(|n| format!("mechanism#{n}")).collect();
        let memory = if mechanism.states.is_empty() {
            None
        } else {
            Some(MechanismSimulator::new(setup, mechanism, candidate, along)?)
        };
        let mut slopes = Vec::new();
        if let Place::Parameter(p) = &candidate.place {
            let name = &model.parameters[*p].name;
            for (e, equation) in model.equations.iter().enumerate() {
                let slope = equation.residual().derivative(name, 0).simplify();
                if slope != Expr::Num(0.0) {
                    slopes.push((e, along.eval(&[slope], &[])?.pop()?));
                }
            }
        }
        Some(Law { setup, mechanism, candidate, along, change, marked, memory, slopes })
    }

    /// What the law does at these values of its own parameters.
    fn components(&self, values: &[f64]) -> Option<Vec<Component>> {
        let changes: Vec<Vec<Vec<f64>>> = match &self.memory {
            Some(recall) => {
                let mut law = recall.law(self.setup, values)?;
                if self.mechanism.on.replaces() {
                    let base = self.along.eval(&[self.candidate.base(&self.setup.model)], &[])?.pop()?;
                    for (l, b) in law[0].iter_mut().flatten().zip(base.iter().flatten()) {
                        *l -= b;
                    }
                }
                law
            }
            None => {
                let extra: Vec<(&str, f64)> =
                    self.marked.iter().map(String::as_str).zip(values.iter().copied()).collect();
                self.along.eval(&self.change, &extra)?
            }
        };
        let mut changes = changes.into_iter();
        let change = changes.next()?;
        let sign = if self.candidate.mirrored { -1.0 } else { 1.0 };
        let nz = self.setup.system.nz;
        Some(match &self.candidate.place {
            Place::Motion(m) | Place::Load { motion: m, .. } | Place::Spring { motion: m, .. } => {
                vec![Component::Force(m.weights.iter().map(|w| w * sign).collect(), change)]
            }
            Place::Pair { own, other } => {
                let mut parts = vec![Component::Force(own.weights.clone(), change)];
                parts.extend(changes.next().map(|r| Component::Force(other.weights.clone(), r)));
                parts
            }
            Place::Equation(e) => vec![Component::Force(unit(nz, *e), change)],
            Place::Input(i) => vec![Component::Input(*i, change)],
            Place::Measurement(c) => vec![Component::Output(*c, change)],
            Place::Parameter(_) => self
                .slopes
                .iter()
                .map(|(e, slope)| {
                    let force = change
                        .iter()
                        .zip(slope)
                        .map(|(c, s)| c.iter().zip(s).map(|(c, s)| c * s).collect())
                        .collect();
                    Component::Force(unit(nz, *e), force)
                })
                .collect(),
        })
    }
}

fn unit(n: usize, at: usize) -> Vec<f64> {
    let mut v = vec![0.0; n];
    v[at] = 1.0;
    v
}

/// A mechanism with states, simulated with the motion that drives it given: a small model whose inputs are
/// the placeholders along the machine's states and whose output is the law.
struct MechanismSimulator {
    system: System,
    /// One environment per piece.
    environments: Vec<Environment>,
    /// Start of its states per piece.
    starts: Vec<Vec<f64>>,
}

impl MechanismSimulator {
    fn new(
        setup: &Setup,
        mechanism: &Mechanism,
        candidate: &Candidate,
        along: &TrajectoryEval<'_>,
    ) -> Option<MechanismSimulator> {
        let keep = |n: &str| n.to_string();
        // Every placeholder in use becomes an input.
        let laws: Vec<&Expr> = std::iter::once(&mechanism.law).chain(&mechanism.reaction).collect();
        let sides = mechanism.states.iter().flat_map(|s| [&s.lhs, &s.rhs]);
        let mut used: Vec<(String, u8)> = Vec::new();
        for e in laws.iter().copied().chain(sides) {
            for (name, primes) in e.variables() {
                let own = mechanism.parameters().any(|p| p == &*name)
                    || mechanism.states.iter().any(|s| s.name == *name)
                    || matches!(&*name, "t" | "pi");
                if !own && !used.iter().any(|u| *u.0 == *name && u.1 == primes) {
                    used.push((name.to_string(), primes));
                }
            }
        }
        let signal = |name: &str, primes: u8| format!("{name}#{primes}");
        let put = |e: &Expr| {
            e.substitute(&|n, p| used.iter().any(|u| u.0 == n && u.1 == p).then(|| Expr::var(&signal(n, p))))
        };
        let none = Unit::dimensionless;
        let mut model = Model {
            name: String::new(),
            units: greybox_model::Units::default(),
            inputs: used
                .iter()
                .map(|(n, p)| {
                    let name = signal(n, *p);
                    Input { channel: name.clone(), name, unit: none(), hold: Hold::Linear, range: None }
                })
                .collect(),
            states: mechanism
                .states
                .iter()
                .map(|s| State {
                    name: s.name.clone(),
                    unit: none(),
                    order: 1,
                    channel: None,
                    initial: vec![],
                })
                .collect(),
            parameters: mechanism
                .parameters()
                .map(|n| Parameter {
                    name: n.to_string(),
                    value: 1.0,
                    unit: None,
                    std: None,
                    fixed: false,
                    positive: None,
                })
                .collect(),
            equations: mechanism
                .states
                .iter()
                .map(|s| Equation { name: s.name.clone(), lhs: put(&s.lhs), rhs: put(&s.rhs) })
                .collect(),
            measurements: laws
                .iter()
                .enumerate()
                .map(|(i, l)| Measurement { channel: format!("law{i}"), expr: put(l), unit: none() })
                .collect(),
        };
        model.recompute_orders();
        let system = System::compile(&model).ok()?;
        let exprs: Vec<Expr> =
            used.iter().map(|(n, p)| candidate.translate(&setup.model, &Expr::prime(n, *p), &keep)).collect();
        let series = along.eval(&exprs, &[])?;
        let environments = setup
            .data
            .pieces
            .iter()
            .enumerate()
            .map(|(i, piece)| Environment {
                start: piece.start,
                dt: piece.dt,
                len: piece.len,
                inputs: series
                    .iter()
                    .map(|s| Signal::new(Hold::Linear, piece.dt, &s[i], |_| Vec::new()))
                    .collect(),
                forces: Vec::new(),
            })
            .collect();
        let starts = memory_starts(setup, mechanism, candidate, along, &model)?;
        Some(MechanismSimulator { system, environments, starts })
    }

    /// The law (and the reaction) per piece.
    fn law(&self, setup: &Setup, values: &[f64]) -> Option<Vec<Vec<Vec<f64>>>> {
        let mut out = vec![Vec::new(); self.system.ny];
        for (environment, start) in self.environments.iter().zip(&self.starts) {
            let n = environment.len;
            let method = Method::Rk4 { substeps: 2 };
            let run = integrate(&self.system, environment, values, start, 0..n, method, &Seeds::default());
            if run.diverged.is_some() {
                return None;
            }
            for (c, out) in out.iter_mut().enumerate() {
                out.push(run.y[c * n..(c + 1) * n].to_vec());
            }
        }
        debug_assert_eq!(out[0].len(), setup.data.pieces.len());
        Some(out)
    }
}

/// Likely start values of a mechanism's own states per piece, in the order of its chains.
fn memory_starts(
    setup: &Setup,
    mechanism: &Mechanism,
    candidate: &Candidate,
    along: &TrajectoryEval<'_>,
    model: &Model,
) -> Option<Vec<Vec<f64>>> {
    let keep = |n: &str| n.to_string();
    let mut starts = vec![Vec::new(); setup.data.pieces.len()];
    for (memory, state) in mechanism.states.iter().zip(&model.states) {
        for primes in 0..state.order {
            let series = match memory.start.get(primes) {
                Some(e) => Some(along.eval(&[candidate.translate(&setup.model, e, &keep)], &[])?.pop()?),
                None => None,
            };
            for (p, start) in starts.iter_mut().enumerate() {
                let v = series.as_ref().and_then(|s| s[p].first().copied()).unwrap_or(0.0);
                start.push(if v.is_finite() { v } else { 0.0 });
            }
        }
    }
    Some(starts)
}

/// Likely start values per piece of the states that a candidate brings along.
pub fn first_states(
    setup: &Setup,
    mechanism: &Mechanism,
    candidate: &Candidate,
    along: &TrajectoryEval<'_>,
) -> Option<Vec<Vec<f64>>> {
    let mut model = setup.model.clone();
    let values = vec![1.0; mechanism.parameters().count()];
    let instance = candidate.insert(&mut model, mechanism, &values);
    model.states.retain(|s| instance.states.contains(&s.name));
    memory_starts(setup, mechanism, candidate, along, &model)
}

/// All choices of the inner parameters' first values, those that the spectrum proposes among them.
fn grid(
    mechanism: &Mechanism,
    candidate: &Candidate,
    scales: &[f64],
    spectra: &Spectra<'_>,
) -> Vec<Vec<f64>> {
    let proposed = mechanism.inner.iter().zip(scales).map(|(inner, scale)| {
        let variable = inner.spectral.as_ref();
        let proposed = variable.map(|v| spectra.propose(candidate, v, inner.carrier.as_ref()));
        let (low, high) = inner.bounds(*scale);
        let admissible = |v: &f64| *v >= low && *v <= high;
        proposed.into_iter().flatten().filter(admissible).collect()
    });
    choices(mechanism, scales, proposed.collect())
}

/// All choices of the inner parameters' first values in the mechanism's file, sizes from [`inner_scales`].
pub fn first_values(mechanism: &Mechanism, scales: &[f64]) -> Vec<Vec<f64>> {
    choices(mechanism, scales, vec![Vec::new(); mechanism.inner.len()])
}

/// All choices of the first values of a mechanism's file and `more` of each inner parameter.
fn choices(mechanism: &Mechanism, scales: &[f64], more: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let mut out: Vec<Vec<f64>> = vec![Vec::new()];
    for ((inner, scale), more) in mechanism.inner.iter().zip(scales).zip(more) {
        let values: Vec<f64> = inner.grid.iter().map(|g| g * scale).chain(more).collect();
        out = out
            .iter()
            .flat_map(|head| values.iter().map(move |v| head.iter().copied().chain([*v]).collect()))
            .collect();
    }
    out
}

/// Inner products of residual, sensitivities and candidate responses, all projected off the initial
/// states.
#[derive(Clone)]
pub struct Gram {
    np: usize,
    /// JᵀJ + Λ.
    pub jj: Vec<f64>,
    /// Λ, the prior's precision per parameter.
    prior: Vec<f64>,
    /// Jᵀr with the prior's pull.
    pub jr: Vec<f64>,
    /// rᵀr.
    pub rr: f64,
    /// JᵀG, `np × lanes`.
    jg: Vec<f64>,
    /// Gᵀr.
    gr: Vec<f64>,
    /// GᵀG block by block.
    gg: Vec<Vec<f64>>,
    blocks: Vec<Range<usize>>,
    lanes: usize,
}

/// A segment's columns with the initial states projected off.
pub struct Projected {
    /// Number of rows.
    pub rows: usize,
    /// Residual.
    pub r: Vec<f64>,
    /// Sensitivities, column by column.
    pub jp: Vec<f64>,
    /// Candidate responses, column by column.
    pub g: Vec<f64>,
}

/// Projects a segment's rows off its initial states.
pub fn project(rows: SegmentRows, nx: usize) -> Projected {
    project_columns(rows, nx, None)
}

/// [`project`] with each column the sum of several lanes.
fn project_columns(rows: SegmentRows, nx: usize, columns: Option<&[Range<usize>]>) -> Projected {
    let SegmentRows { rows: m, mut r, jx, mut jp, mut signals, .. } = rows;
    if let Some(columns) = columns
        && columns.len() * m != signals.len()
    {
        let mut sums = vec![0.0; columns.len() * m];
        for (lanes, sum) in columns.iter().zip(sums.chunks_mut(m)) {
            for lane in lanes.clone() {
                sum.iter_mut().zip(&signals[lane * m..(lane + 1) * m]).for_each(|(a, b)| *a += b);
            }
        }
        signals = sums;
    }
    let mut q = jx;
    qr::orthonormalise(&mut q, m, nx);
    for column in std::iter::once(&mut r[..]).chain(jp.chunks_mut(m)).chain(signals.chunks_mut(m)) {
        qr::project_off(&q, m, column);
    }
    Projected { rows: m, r, jp, g: signals }
}

/// A block with the parameters projected off.
struct Projection {
    gg: Vec<f64>,
    gr: Vec<f64>,
    /// What the parameters do for each column, and for the residual.
    columns: Vec<Vec<f64>>,
    base: Vec<f64>,
}

impl Gram {
    /// No rows yet: of `np` parameters and so many lanes, with the mutual products of these blocks of them.
    pub fn new(np: usize, lanes: usize, blocks: &[Range<usize>]) -> Gram {
        Gram {
            np,
            jj: vec![0.0; np * np],
            prior: vec![0.0; np],
            jr: vec![0.0; np],
            rr: 0.0,
            jg: vec![0.0; np * lanes],
            gr: vec![0.0; lanes],
            gg: blocks.iter().map(|b| vec![0.0; b.len() * b.len()]).collect(),
            blocks: blocks.to_vec(),
            lanes,
        }
    }

    /// Adds a row of unit variance: residual, sensitivities, candidate responses.
    pub fn add_row(&mut self, r: f64, j: &[f64], g: &[f64]) {
        let (np, lanes) = (self.np, self.lanes);
        self.rr += r * r;
        for a in 0..np {
            self.jr[a] += j[a] * r;
            for b in 0..np {
                self.jj[a * np + b] += j[a] * j[b];
            }
            let row = &mut self.jg[a * lanes..(a + 1) * lanes];
            row.iter_mut().zip(g).for_each(|(s, g)| *s += j[a] * g);
        }
        self.gr.iter_mut().zip(g).for_each(|(s, g)| *s += g * r);
        for (block, gg) in self.blocks.iter().zip(&mut self.gg) {
            let g = &g[block.clone()];
            for (a, row) in g.iter().zip(gg.chunks_exact_mut(g.len().max(1))) {
                row.iter_mut().zip(g).for_each(|(s, b)| *s += a * b);
            }
        }
    }

    /// Adds the rows of another of the same shape.
    pub fn add(&mut self, other: &Gram) {
        self.rr += other.rr;
        let add = |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        add(&mut self.jj, &other.jj);
        add(&mut self.jr, &other.jr);
        add(&mut self.jg, &other.jg);
        add(&mut self.gr, &other.gr);
        for (a, b) in self.gg.iter_mut().zip(&other.gg) {
            add(a, b);
        }
    }

    /// Adds what is known of the parameters at these values, where a row's square is worth `weight` of the priors'.
    pub fn add_priors(&mut self, free: &[FreeParameter], parameters: &[f64], weight: f64) {
        for (i, f) in free.iter().enumerate() {
            let (g, slope) = f.prior.at(parameters[f.index]);
            self.jj[i * self.np + i] += slope * slope / weight;
            self.prior[i] = slope * slope / weight;
            self.jr[i] -= slope * g / weight;
        }
    }
}

/// Simulates with the lanes and gathers the inner products; `blocks` are the groups of lanes whose
/// mutual products are wanted.
pub fn gram(
    setup: &Setup,
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
    signals: &[Arc<SignalLanes>],
    columns: &[Range<usize>],
    blocks: Vec<Range<usize>>,
) -> Gram {
    let nx = setup.system.nx;
    let np = setup.free.len();
    let lanes = columns.len();
    let rows = setup.with_problem(level, scale, |p| p.rows(point, true, (lanes > 0).then_some(signals)));
    let parts: Vec<Gram> = rows
        .into_par_iter()
        .map(|rows| {
            let s = project_columns(rows, nx, Some(columns));
            let m = s.rows;
            let j = |a: usize| &s.jp[a * m..(a + 1) * m];
            let g = |a: usize| &s.g[a * m..(a + 1) * m];
            let mut part = Gram {
                np,
                jj: vec![0.0; np * np],
                prior: vec![0.0; np],
                jr: (0..np).map(|a| qr::dot(j(a), &s.r)).collect(),
                rr: qr::dot(&s.r, &s.r),
                jg: vec![0.0; np * lanes],
                gr: (0..lanes).map(|a| qr::dot(g(a), &s.r)).collect(),
                gg: Vec::new(),
                blocks: blocks.clone(),
                lanes,
            };
            for a in 0..np {
                for b in 0..=a {
                    let v = qr::dot(j(a), j(b));
                    part.jj[a * np + b] = v;
                    part.jj[b * np + a] = v;
                }
                for l in 0..lanes {
                    part.jg[a * lanes + l] = qr::dot(j(a), g(l));
                }
            }
            for block in &blocks {
                let n = block.len();
                let mut gg = vec![0.0; n * n];
                for a in 0..n {
                    for b in 0..=a {
                        let v = qr::dot(g(block.start + a), g(block.start + b));
                        gg[a * n + b] = v;
                        gg[b * n + a] = v;
                    }
                }
                part.gg.push(gg);
            }
            part
        })
        .collect();
    // Summed in the order of the segments: the same bytes whatever the number of threads.
    let mut total = Gram::new(np, lanes, &blocks);
    parts.iter().for_each(|part| total.add(part));
    total.add_priors(&setup.free, &point.parameters, 1.0);
    total
}

/// Solves a x = b, scaled to unit diagonal: the parameters' units differ by many decades.
fn solve_scaled(a: &[f64], n: usize, b: &[f64]) -> Vec<f64> {
    let d: Vec<f64> = (0..n).map(|i| if a[i * n + i] > 0.0 { a[i * n + i].sqrt() } else { 1.0 }).collect();
    let scaled: Vec<f64> = (0..n * n).map(|i| a[i] / (d[i / n] * d[i % n])).collect();
    let b: Vec<f64> = b.iter().zip(&d).map(|(b, d)| b / d).collect();
    qr::solve_spd(&scaled, n, &b).iter().zip(&d).map(|(x, d)| x / d).collect()
}

/// A block regressed on the residual, everything else refitted.
pub struct Regressed {
    /// Coefficients of the block's columns (zero where dropped).
    pub coefficients: Vec<f64>,
    /// Share of the residual explained.
    pub gain: f64,
    /// Shift of the free parameters.
    pub shift: Vec<f64>,
}

impl Gram {
    /// rᵀPr: what remains after refitting the parameters to first order.
    pub fn remaining(&self) -> f64 {
        let x = self.solve(&self.jr);
        (self.rr - qr::dot(&x, &self.jr)).max(0.0)
    }

    /// Share of a column's sum of squares that the parameters cannot do, whatever the prior says of them.
    fn independence(&self, column: usize, size: f64) -> f64 {
        let jg: Vec<f64> = (0..self.np).map(|a| self.jg[a * self.lanes + column]).collect();
        let mut data = self.jj.clone();
        for (i, p) in self.prior.iter().enumerate() {
            // A trace of the diagonal keeps unseen parameters from everything.
            let d = (data[i * self.np + i] - p).max(0.0);
            data[i * self.np + i] = d * (1.0 + 1e-9);
        }
        let x = solve_scaled(&data, self.np, &jg);
        1.0 - qr::dot(&x, &jg) / size.max(1e-300)
    }

    fn solve(&self, b: &[f64]) -> Vec<f64> {
        solve_scaled(&self.jj, self.np, b)
    }

    /// The same without some of the parameters, each where it would be if its value were lower by so much: what it did is in
    /// the residual.
    #[must_use]
    pub fn without(&self, gone: &[(usize, f64)]) -> Gram {
        let (np, lanes) = (self.np, self.lanes);
        let kept: Vec<usize> = (0..np).filter(|a| gone.iter().all(|g| g.0 != *a)).collect();
        let mut all = self.clone();
        for (i, by) in gone {
            // r + J by, column by column.
            all.rr += 2.0 * by * all.jr[*i] + by * by * self.jj[i * np + i];
            for a in 0..np {
                all.jr[a] += by * self.jj[a * np + i];
            }
            for l in 0..lanes {
                all.gr[l] += by * self.jg[i * lanes + l];
            }
        }
        let n = kept.len();
        let mut out =
            Gram { np: n, jj: vec![0.0; n * n], prior: vec![0.0; n], jr: Vec::new(), jg: Vec::new(), ..all };
        for (i, a) in kept.iter().enumerate() {
            for (j, b) in kept.iter().enumerate() {
                out.jj[i * n + j] = self.jj[a * np + b];
            }
            out.prior[i] = self.prior[*a];
            out.jr.push(all.jr[*a]);
            out.jg.extend_from_slice(&self.jg[a * lanes..(a + 1) * lanes]);
        }
        out
    }

    /// The same with what some columns do, by so much each, in the residual. Of one block.
    #[must_use]
    fn with_columns(&self, did: &[(usize, f64)]) -> Gram {
        let (np, lanes) = (self.np, self.lanes);
        let mut out = self.clone();
        for (i, by) in did {
            out.rr += 2.0 * by * out.gr[*i] + by * by * self.gg[0][i * lanes + i];
            for a in 0..np {
                out.jr[a] += by * self.jg[a * lanes + i];
            }
            for l in 0..lanes {
                out.gr[l] += by * self.gg[0][l * lanes + i];
            }
        }
        out
    }

    /// GᵀG and Gᵀr of block `index` with the parameters projected off.
    pub fn projected(&self, index: usize) -> (Vec<f64>, Vec<f64>) {
        let Projection { gg, gr, .. } = self.projection(index);
        (gg, gr)
    }

    fn projection(&self, index: usize) -> Projection {
        let block = self.blocks[index].clone();
        let n = block.len();
        let np = self.np;
        let columns: Vec<Vec<f64>> = block
            .clone()
            .map(|l| self.solve(&(0..np).map(|a| self.jg[a * self.lanes + l]).collect::<Vec<_>>()))
            .collect();
        let base = self.solve(&self.jr);
        let jg = |a: usize, l: usize| self.jg[a * self.lanes + block.start + l];
        let mut gg = vec![0.0; n * n];
        let mut gr = vec![0.0; n];
        for a in 0..n {
            for b in 0..n {
                gg[a * n + b] =
                    self.gg[index][a * n + b] - (0..np).map(|i| jg(i, a) * columns[b][i]).sum::<f64>();
            }
            gr[a] = self.gr[block.start + a] - (0..np).map(|i| jg(i, a) * base[i]).sum::<f64>();
        }
        Projection { gg, gr, columns, base }
    }

    /// Regresses block `index`; `positive[i]` drops column i when its coefficient comes out negative.
    /// `None` when the block adds nothing that the parameters cannot do already.
    pub fn regress(&self, index: usize, positive: &[bool], ridge: f64) -> Option<Regressed> {
        let block = self.blocks[index].clone();
        let (n, np) = (block.len(), self.np);
        let Projection { gg, gr, columns, base } = self.projection(index);
        let mut kept: Vec<usize> = (0..n)
            .filter(|&a| {
                let size = self.gg[index][a * n + a];
                gg[a * n + a] > 0.0 && self.independence(block.start + a, size) > INDEPENDENT
            })
            .collect();
        let rr = self.remaining();
        loop {
            if kept.is_empty() {
                return None;
            }
            let m = kept.len();
            let d: Vec<f64> = kept.iter().map(|&a| gg[a * n + a].sqrt()).collect();
            let mut a: Vec<f64> = vec![0.0; m * m];
            for i in 0..m {
                for j in 0..m {
                    a[i * m + j] = gg[kept[i] * n + kept[j]] / (d[i] * d[j]);
                }
                a[i * m + i] += ridge / (d[i] * d[i]) + 1e-12;
            }
            let b: Vec<f64> = (0..m).map(|i| gr[kept[i]] / d[i]).collect();
            let x = qr::solve_spd(&a, m, &b);
            let bad: Vec<usize> = (0..m).filter(|&i| positive[kept[i]] && x[i] < 0.0).collect();
            if let Some(&worst) = bad.iter().min_by(|&&i, &&j| x[i].total_cmp(&x[j])) {
                kept.remove(worst);
                continue;
            }
            let mut coefficients = vec![0.0; n];
            let mut explained = 0.0;
            for i in 0..m {
                coefficients[kept[i]] = x[i] / d[i];
                explained += x[i] * b[i];
            }
            let shift = (0..np)
                .map(|i| base[i] - (0..n).map(|c| columns[c][i] * coefficients[c]).sum::<f64>())
                .collect();
            return Some(Regressed { coefficients, gain: explained / rr.max(1e-300), shift });
        }
    }
}

/// Candidates that explain more together, with the values that they have together.
#[derive(Debug, Clone)]
pub struct Together {
    /// Each with its share in this.
    pub members: Vec<Scored>,
    /// Share of the residual sum of squares that they explain, to first order.
    pub gain: f64,
    /// First-order shift of the free parameters that goes with them.
    pub shift: Vec<f64>,
}

/// What is added to the size of each column of a set, that of two alike neither grows beyond all bounds; and where the
/// columns explain a hundred million times what is left, so that any more would be seen in that.
const RIDGE: f64 = 1e-6;
const LEAST_RIDGE: f64 = 1e-12;

/// Least share that a pair must explain, and least surplus over its members alone.
const PAIR_GAIN: f64 = 0.05;

/// The columns of all candidates around a fit.
fn lanes_at(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
) -> CandidateResponses {
    let (along, forces) = TrajectoryEval::observed(setup, level, scale, point);
    let spectra = Spectra::new(setup, level, scale, point, &along, &forces);
    lanes(setup, library, candidates, &along, &spectra)
}

/// The same with the products of each variant's own responses.
fn variants_at(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
) -> (CandidateResponses, Gram) {
    let lanes = lanes_at(setup, library, candidates, level, scale, point);
    let blocks: Vec<Range<usize>> = lanes.variants.iter().map(|v| v.columns.clone()).collect();
    let gram = gram(setup, level, scale, point, &lanes.signals, &lanes.columns, blocks);
    (lanes, gram)
}

/// The same with the products of all responses with each other.
fn responses(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
) -> (CandidateResponses, Gram) {
    let lanes = lanes_at(setup, library, candidates, level, scale, point);
    let whole = 0..lanes.columns.len();
    let gram = gram(setup, level, scale, point, &lanes.signals, &lanes.columns, vec![whole]);
    (lanes, gram)
}

/// All candidates in one Gram matrix, the parameters projected out: a regression on a few of its columns costs
/// next to nothing.
struct Regressions<'a> {
    library: &'a [Mechanism],
    candidates: &'a [Candidate],
    lanes: CandidateResponses,
    np: usize,
    /// What the parameters do for each column, and for the residual.
    solved: Vec<Vec<f64>>,
    base: Vec<f64>,
    /// GᵀG and Gᵀr, projected.
    gg: Vec<f64>,
    gr: Vec<f64>,
    /// Columns that the parameters cannot do already.
    independent: Vec<bool>,
    /// rᵀPr.
    rr: f64,
}

impl<'a> Regressions<'a> {
    fn new(
        setup: &Setup,
        library: &'a [Mechanism],
        candidates: &'a [Candidate],
        level: &Segmentation,
        scale: &[f64],
        point: &Point,
    ) -> Regressions<'a> {
        let (lanes, gram) = responses(setup, library, candidates, level, scale, point);
        Regressions::of(library, candidates, lanes, &gram)
    }

    fn of(
        library: &'a [Mechanism],
        candidates: &'a [Candidate],
        lanes: CandidateResponses,
        gram: &Gram,
    ) -> Regressions<'a> {
        let n = lanes.columns.len();
        let Projection { gg, gr, columns: solved, base } = gram.projection(0);
        let independent =
            |a: usize| gg[a * n + a] > 0.0 && gram.independence(a, gram.gg[0][a * n + a]) > INDEPENDENT;
        let independent = (0..n).map(independent).collect();
        let (np, rr) = (gram.np, gram.remaining().max(1e-300));
        Regressions { library, candidates, lanes, np, solved, base, gg, gr, independent, rr }
    }

    /// Which of a variant's coefficients cannot be negative.
    fn positive(&self, v: &Variant) -> Vec<bool> {
        let mechanism = &self.library[self.candidates[v.candidate].mechanism];
        match v.finite_difference {
            Some(_) => vec![true],
            None => mechanism.linear.iter().map(|l| mechanism.positive.contains(l)).collect(),
        }
    }

    /// Coefficients of a few columns and the share that they explain, each column with so much of its own size more;
    /// `None` where a sign is impossible.
    fn regress(&self, columns: &[usize], positive: &[bool], ridge: f64) -> Option<(Vec<f64>, f64)> {
        if columns.iter().any(|&c| !self.independent[c]) {
            return None;
        }
        let (n, m) = (self.lanes.columns.len(), columns.len());
        let projected = |a: usize, b: usize| self.gg[columns[a] * n + columns[b]];
        let d: Vec<f64> = (0..m).map(|i| projected(i, i).sqrt()).collect();
        let mut a = vec![0.0; m * m];
        for i in 0..m {
            for j in 0..m {
                a[i * m + j] = projected(i, j) / (d[i] * d[j]);
            }
            a[i * m + i] += ridge;
        }
        let b: Vec<f64> = (0..m).map(|i| self.gr[columns[i]] / d[i]).collect();
        let x = qr::solve_spd(&a, m, &b);
        let gain = qr::dot(&x, &b) / self.rr;
        let c: Vec<f64> = x.iter().zip(&d).map(|(x, d)| x / d).collect();
        let allowed = c.iter().zip(positive).all(|(c, p)| !p || *c > 0.0);
        (allowed && gain.is_finite()).then_some((c, gain))
    }

    /// A variant with these coefficients of its columns.
    fn member(&self, variant: &Variant, c: &[f64], gain: f64) -> Option<Scored> {
        let mechanism = &self.library[self.candidates[variant.candidate].mechanism];
        let values = match variant.finite_difference {
            None => mechanism.values(c, &variant.inner),
            Some(true) if c[0] < 3.0 => mechanism.values(&[], &variant.scaled(mechanism, c[0])),
            Some(_) => mechanism.values(&[], &variant.inner),
        }?;
        Some(Scored {
            candidate: variant.candidate,
            gain,
            values,
            shift: vec![0.0; self.np],
            scales: variant.scales.clone(),
            reduced_start: None,
            others: Vec::new(),
        })
    }

    /// Variants with these coefficients of all their columns.
    fn together(&self, variants: &[usize], coefficients: &[f64], gain: f64) -> Option<Together> {
        let (mut members, mut shift, mut from) = (Vec::new(), self.base.clone(), 0);
        for &v in variants {
            let variant = &self.lanes.variants[v];
            let own = &coefficients[from..from + variant.columns.len()];
            from += own.len();
            members.push(self.member(variant, own, gain)?);
            for (column, c) in variant.columns.clone().zip(own) {
                shift.iter_mut().zip(&self.solved[column]).for_each(|(s, x)| *s -= c * x);
            }
        }
        Some(Together { members, gain, shift })
    }
}

/// The pairs of candidates that gain most beyond what their members gain alone, best first, at most `most`.
///
/// With the parameters projected out, every pair is a regression on two to four columns of one common
/// Gram matrix: all of them cost less than the fit of a single one.
pub fn screen_pairs(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
    most: usize,
) -> Vec<Together> {
    let all = Regressions::new(setup, library, candidates, level, scale, point);
    let variants = &all.lanes.variants;
    let usable: Vec<(usize, Vec<usize>, Vec<bool>, f64)> = variants
        .iter()
        .enumerate()
        .map(|(i, v)| {
            let (columns, positive): (Vec<usize>, Vec<bool>) = (v.columns.clone().collect(), all.positive(v));
            let alone = all.regress(&columns, &positive, RIDGE).map_or(0.0, |r| r.1.max(0.0));
            (i, columns, positive, alone)
        })
        .filter(|v| v.1.len() <= 2 && v.1.iter().all(|&c| all.independent[c]))
        .collect();
    let mut found: Vec<(f64, usize, usize, Vec<f64>)> = (0..usable.len())
        .into_par_iter()
        .flat_map_iter(|i| {
            let (usable, all) = (&usable, &all);
            (i + 1..usable.len()).filter_map(move |j| {
                let ((v, cv, pv, gv), (w, cw, pw, gw)) = (&usable[i], &usable[j]);
                if variants[*v].candidate == variants[*w].candidate {
                    return None;
                }
                let columns: Vec<usize> = cv.iter().chain(cw).copied().collect();
                let signs: Vec<bool> = pv.iter().chain(pw).copied().collect();
                let (c, gain) = all.regress(&columns, &signs, RIDGE)?;
                (gain > gv + gw + PAIR_GAIN).then_some((gain, i, j, c))
            })
        })
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut out: Vec<Together> = Vec::new();
    for (gain, i, j, c) in found {
        let (v, w) = (usable[i].0, usable[j].0);
        let of = [variants[v].candidate, variants[w].candidate];
        if out.iter().any(|p| p.members.iter().map(|m| m.candidate).eq(of)) {
            continue;
        }
        out.extend(all.together(&[v, w], &c, gain));
        if out.len() == most {
            break;
        }
    }
    out
}

/// Up to `most` candidates, each the one that explains most beside those before it, with the values that they have
/// together: orthogonal matching pursuit (Pati, Rezaiifar and Krishnaprasad, Asilomar 1993) on the Gram matrix of all
/// responses, the parameters refitted to first order. `None` where nothing explains anything.
pub fn screen_set(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
    most: usize,
) -> Option<Together> {
    let all = Regressions::new(setup, library, candidates, level, scale, point);
    let variants = &all.lanes.variants;
    let columns = |chosen: &[usize]| -> (Vec<usize>, Vec<bool>) {
        let of = || chosen.iter().map(|&v| &variants[v]);
        (of().flat_map(|v| v.columns.clone()).collect(), of().flat_map(|v| all.positive(v)).collect())
    };
    let mut chosen: Vec<usize> = Vec::new();
    let mut best: Option<(Vec<f64>, f64)> = None;
    while chosen.len() < most {
        let open = (0..variants.len())
            .filter(|&v| chosen.iter().all(|&c| variants[c].candidate != variants[v].candidate));
        let tried = open.filter_map(|v| {
            let with: Vec<usize> = chosen.iter().copied().chain([v]).collect();
            let (columns, positive) = columns(&with);
            Some((v, all.regress(&columns, &positive, RIDGE)?))
        });
        let least = best.as_ref().map_or(0.0, |b| b.1);
        let next = tried.filter(|t| t.1.1 > least).max_by(|a, b| a.1.1.total_cmp(&b.1.1).then(b.0.cmp(&a.0)));
        let Some((v, result)) = next else { break };
        chosen.push(v);
        best = Some(result);
    }
    let (coefficients, gain) = best?;
    all.together(&chosen, &coefficients, gain)
}

/// Widths of a free shape that are tried, each twice the one before.
const WIDTHS: i32 = 30;

/// The laws of free shape that make the residual likelier, the likeliest first: each with the size of the largest marginal
/// likelihood ([`evidence`], every square worth `weight`), and the likeliest function of that size.
pub(crate) fn screen_shapes(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
    weight: f64,
) -> Vec<Together> {
    let (lanes, gram) = variants_at(setup, library, candidates, level, scale, point);
    let sized = |index: usize| {
        let Projection { gg, gr, columns, base } = gram.projection(index);
        let n = gr.len();
        let root: Vec<f64> = (0..n * n).map(|i| f64::from(u8::from(i / n == i % n))).collect();
        let strongest = (0..n).map(|i| gg[i * n + i]).fold(0.0, f64::max);
        if !(strongest.is_finite() && strongest > 0.0) {
            return None;
        }
        // From where the best known of them is just known.
        let least = 1.0 / (weight * strongest).sqrt();
        let tried = (0..WIDTHS).map(|i| least * 2f64.powi(i));
        let tried = tried.map(|width| (evidence(&root, &gg, &gr, weight, width), width));
        let (evidence, width) = tried.filter(|t| t.0.is_finite()).max_by(|a, b| a.0.total_cmp(&b.0))?;
        let mut precision: Vec<f64> = gg.iter().map(|v| weight * v).collect();
        (0..n).for_each(|i| precision[i * n + i] += 1.0 / (width * width));
        let wanted: Vec<f64> = gr.iter().map(|v| weight * v).collect();
        let changes = qr::solve_spd(&precision, n, &wanted);
        let explained = 2.0 * qr::dot(&changes, &gr)
            - (0..n).map(|i| changes[i] * qr::dot(&gg[i * n..(i + 1) * n], &changes)).sum::<f64>();
        let mut shift = base;
        for (column, change) in columns.iter().zip(&changes) {
            shift.iter_mut().zip(column).for_each(|(s, x)| *s -= change * x);
        }
        let gain = explained / gram.remaining().max(1e-300);
        let variant = &lanes.variants[index];
        let mechanism = &library[candidates[variant.candidate].mechanism];
        // (In a fit, where a square is worth one, what has the same balance of residual and size.)
        let size = width * weight.sqrt();
        let [root, _] = variant.inner[..] else { return None };
        let changes: Vec<f64> = changes.iter().map(|c| c / size).collect();
        let values = mechanism.values(&changes, &[root, size])?;
        let scored = Scored {
            candidate: variant.candidate,
            gain,
            values,
            shift: shift.clone(),
            scales: variant.scales.clone(),
            reduced_start: None,
            others: Vec::new(),
        };
        Some((evidence, Together { members: vec![scored], gain, shift }))
    };
    let mut sized: Vec<(f64, Together)> = (0..lanes.variants.len()).filter_map(sized).collect();
    sized.retain(|shape| shape.0 > 0.0);
    sized.sort_by(|a, b| b.0.total_cmp(&a.0));
    sized.into_iter().map(|shape| shape.1).collect()
}

/// A term that a model holds, of one coefficient.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Held {
    /// Which of the candidates it is.
    pub(crate) candidate: usize,
    /// Position of its coefficient among the free parameters, and its value.
    pub(crate) position: usize,
    pub(crate) value: f64,
}

/// Which terms do the work of those that are `held` at the least cost:
///
/// ```text
/// min over S of  Σ_{i ∈ S} price(i) + min over c, δ of ‖r + Σ_{held} vⱼ gⱼ − Σ_{i ∈ S} cᵢ gᵢ − J δ‖²
/// ```
///
/// with the residual r over its scale, the responses g of all candidates of one column, the held values v, and the
/// sensitivities J to all other free parameters. From what is held, each step takes the best of one term more, one less, or
/// another for one of them, for as long as the cost falls (stepwise selection with exchanges: Miller, *Subset Selection in
/// Regression*, 2002, §3.6). First order is good here because the forces of either choice add up to about the same.
/// `None` where what is held costs least, or one of its terms has no column of its own.
pub(crate) fn reselect(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
    held: &[Held],
    price: &(dyn Fn(&Candidate) -> f64 + Sync),
) -> Option<Together> {
    struct Told {
        cost: f64,
        coefficients: Vec<f64>,
        gain: f64,
    }
    let (lanes, gram) = responses(setup, library, candidates, level, scale, point);
    let single = |candidate: usize| {
        lanes
            .variants
            .iter()
            .position(|v| v.candidate == candidate && v.columns.len() == 1 && v.finite_difference.is_none())
    };
    let chosen: Vec<usize> = held.iter().map(|h| single(h.candidate)).collect::<Option<_>>()?;
    let did: Vec<(usize, f64)> =
        chosen.iter().zip(held).map(|(&v, h)| (lanes.variants[v].columns.start, h.value)).collect();
    let gone: Vec<(usize, f64)> = held.iter().map(|h| (h.position, 0.0)).collect();
    let open: Vec<usize> = (0..candidates.len()).filter_map(single).collect();
    let all = Regressions::of(library, candidates, lanes, &gram.without(&gone).with_columns(&did));
    let variants = &all.lanes.variants;
    let told = |chosen: &[usize]| -> Option<Told> {
        let columns: Vec<usize> = chosen.iter().map(|&v| variants[v].columns.start).collect();
        let positive: Vec<bool> = chosen.iter().flat_map(|&v| all.positive(&variants[v])).collect();
        let (coefficients, gain) = all.regress(&columns, &positive, LEAST_RIDGE)?;
        let paid: f64 = chosen.iter().map(|&v| price(&candidates[variants[v].candidate])).sum();
        Some(Told { cost: paid - gain * all.rr, coefficients, gain })
    };
    let mut best = (told(&chosen)?, chosen.clone());
    loop {
        let (own, current) = &best;
        let with = |set: &[usize]| -> Vec<Vec<usize>> {
            let others = open.iter().filter(|v| !current.contains(v));
            others.map(|&v| [set, &[v]].concat()).collect()
        };
        let mut moves = with(current);
        for i in 0..current.len() {
            let less = [&current[..i], &current[i + 1..]].concat();
            moves.extend(with(&less));
            moves.push(less);
        }
        let tried = moves.into_par_iter().filter_map(|set| Some((told(&set)?, set)));
        let next = tried.min_by(|a, b| a.0.cost.total_cmp(&b.0.cost).then_with(|| a.1.cmp(&b.1)));
        match next {
            // (Less is rounding.)
            Some(next) if next.0.cost < own.cost - 1e-6 => best = next,
            _ => break,
        }
    }
    let (told, set) = best;
    let is_same = set.len() == chosen.len() && set.iter().all(|v| chosen.contains(v));
    if is_same { None } else { all.together(&set, &told.coefficients, told.gain) }
}

/// First-order shift of the other free parameters when those at these positions go to zero from `values`.
pub fn shift_without(
    setup: &Setup,
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
    gone: &[(usize, f64)],
) -> Vec<f64> {
    let gram = gram(setup, level, scale, point, &[], &[], Vec::new()).without(gone);
    gram.solve(&gram.jr)
}

/// Scores every candidate at the point of a fit, best first.
pub fn screen(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Segmentation,
    scale: &[f64],
    point: &Point,
) -> Vec<Scored> {
    let (lanes, gram) = variants_at(setup, library, candidates, level, scale, point);
    scored(library, candidates, &lanes, &gram)
}

/// What the inner products say of every candidate, best first.
pub fn scored(
    library: &[Mechanism],
    candidates: &[Candidate],
    lanes: &CandidateResponses,
    gram: &Gram,
) -> Vec<Scored> {
    let mut found: Vec<Vec<Scored>> = vec![Vec::new(); candidates.len()];
    for (index, variant) in lanes.variants.iter().enumerate() {
        let candidate = &candidates[variant.candidate];
        let mechanism = &library[candidate.mechanism];
        let positive: Vec<bool> = if variant.finite_difference.is_some() {
            vec![true]
        } else {
            mechanism.linear.iter().map(|n| mechanism.positive.contains(n)).collect()
        };
        let Some(regressed) = gram.regress(index, &positive, 0.0) else { continue };
        let mut reduced_start = None;
        let (gain, values) = match variant.finite_difference {
            None => {
                let tenth: Vec<f64> = regressed.coefficients.iter().map(|c| 0.1 * c).collect();
                reduced_start = mechanism.values(&tenth, &variant.inner);
                (regressed.gain, mechanism.values(&regressed.coefficients, &variant.inner))
            }
            Some(scalable) => {
                let c = regressed.coefficients[0];
                if scalable {
                    reduced_start = mechanism.values(&[], &variant.scaled(mechanism, 0.2 * c.min(1.0)));
                }
                if scalable && c < 3.0 {
                    (regressed.gain, mechanism.values(&[], &variant.scaled(mechanism, c)))
                } else {
                    // Gain with the coefficient held at one: c(2 − 1/c) of the best.
                    let gain = if c > 0.0 { regressed.gain * (2.0 / c - 1.0 / (c * c)) } else { 0.0 };
                    (gain, mechanism.values(&[], &variant.inner))
                }
            }
        };
        let Some(values) = values else { continue };
        if gain <= 0.0 || gain.is_nan() || !values.iter().all(|v| v.is_finite()) {
            continue;
        }
        found[variant.candidate].push(Scored {
            candidate: variant.candidate,
            gain,
            values,
            shift: regressed.shift,
            scales: variant.scales.clone(),
            reduced_start,
            others: Vec::new(),
        });
    }
    let mut scored: Vec<Scored> = found
        .into_iter()
        .filter_map(|mut variants| {
            variants.sort_by(|a, b| b.gain.total_cmp(&a.gain));
            let mut rest = variants.into_iter();
            let mut best = rest.next()?;
            best.others = rest.take(2).map(|v| (v.gain, v.values, v.shift)).collect();
            Some(best)
        })
        .collect();
    scored.sort_by(|a, b| b.gain.total_cmp(&a.gain).then(a.candidate.cmp(&b.candidate)));
    scored
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Leaving a parameter out of the inner products is leaving it out of every row, with what it did in the residual.
    #[test]
    fn a_parameter_is_left_out_with_its_effect_in_the_residual() {
        let blocks = [0..2, 2..3];
        let (mut all, mut left) = (Gram::new(3, 3, &blocks), Gram::new(1, 3, &blocks));
        for k in 0..12 {
            let x = |i: i32| (f64::from(k) * 0.7 + f64::from(i * i) * 1.3).sin();
            let (r, j, g) = (x(0), [x(1), x(2), x(3)], [x(4), x(5) * 2.0, x(6)]);
            all.add_row(r, &j, &g);
            left.add_row(r + 0.6 * j[0] - 1.5 * j[2], &[j[1]], &g);
        }
        let without = all.without(&[(0, 0.6), (2, -1.5)]);
        let close = |a: &[f64], b: &[f64]| {
            assert_eq!(a.len(), b.len());
            a.iter().zip(b).for_each(|(a, b)| assert!((a - b).abs() < 1e-9, "{a} {b}"));
        };
        close(&[without.rr], &[left.rr]);
        close(&without.jj, &left.jj);
        close(&without.jr, &left.jr);
        close(&without.jg, &left.jg);
        close(&without.gr, &left.gr);
        for index in 0..2 {
            let ((gg, gr), (its, own)) = (without.projected(index), left.projected(index));
            close(&gg, &its);
            close(&gr, &own);
        }
        assert!((without.remaining() - left.remaining()).abs() < 1e-9);
    }
}
