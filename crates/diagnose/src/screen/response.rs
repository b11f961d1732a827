//! What a candidate adds to the outputs, to first order: its columns along the simulated motion, for each choice of its constants.

use std::ops::Range;
use std::sync::Arc;

use greybox_calibrate::Setup;
use greybox_model::{Equation, Expr, Hold, Input, Measurement, Model, Parameter, State, System, Unit};
use greybox_simulate::{Environment, Method, Seeds, Signal, SignalLanes, integrate};
use rayon::prelude::*;

use crate::candidate::Candidate;
use crate::library::{Mechanism, Scale};
use crate::place::Place;
use crate::spectra::Spectra;
use crate::trajectory::{Cover, TrajectoryEval};

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
    pub(super) fn scaled(&self, mechanism: &Mechanism, factor: f64) -> Vec<f64> {
        let bounds = mechanism.inner.iter().zip(&self.scales).map(|(inner, scale)| inner.bounds(scale.abs()));
        self.inner.iter().zip(bounds).map(|(v, (low, high))| (v * factor).max(low).min(high)).collect()
    }
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

/// Builds the lanes of all candidates along given states, for what simulates the samples of a cover; `spectra` proposes angular
/// frequencies.
pub(crate) fn lanes(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    along: &TrajectoryEval<'_>,
    spectra: &Spectra<'_>,
    cover: &Cover,
) -> CandidateResponses {
    let made: Vec<Vec<(Variant, Vec<Vec<Component>>)>> = candidates
        .par_iter()
        .enumerate()
        .map(|(index, candidate)| {
            let mechanism = &library[candidate.mechanism];
            variants(setup, mechanism, (candidate, index), along, spectra, cover)
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
    CandidateResponses { signals: signals_on(setup, &components, cover), columns, variants }
}

/// What a simulation adds, one lane for each component; per piece.
pub fn signals(setup: &Setup, components: &[Component]) -> Vec<Arc<SignalLanes>> {
    signals_on(setup, components, &Cover::default())
}

/// The same of components that are known at the samples of a cover.
fn signals_on(setup: &Setup, components: &[Component], cover: &Cover) -> Vec<Arc<SignalLanes>> {
    let (count, nz) = (components.len(), setup.system.nz);
    setup
        .data
        .pieces
        .iter()
        .enumerate()
        .map(|(p, piece)| {
            let len = cover.samples(p).map_or(piece.len, <[u32]>::len);
            let mut lanes = SignalLanes {
                lanes: count,
                weights: vec![0.0; nz * count],
                force: vec![0.0; len * count],
                rows: cover.rows(p, piece.len),
                ..SignalLanes::default()
            };
            let put = |tables: &mut Vec<(usize, Vec<f64>)>, of: usize, l: usize, series: &[f64]| {
                let at = tables.iter().position(|t| t.0 == of).unwrap_or_else(|| {
                    tables.push((of, vec![0.0; len * count]));
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
    Law::new(setup, mechanism, candidate, along, &Cover::default())?.components(values)
}

/// The columns of a candidate for every choice of its inner parameters.
fn variants(
    setup: &Setup,
    mechanism: &Mechanism,
    (candidate, index): (&Candidate, usize),
    along: &TrajectoryEval<'_>,
    spectra: &Spectra<'_>,
    cover: &Cover,
) -> Vec<(Variant, Vec<Vec<Component>>)> {
    let mut out = Vec::new();
    let Some(scales) = inner_scales(mechanism, candidate, along, setup) else { return out };
    if mechanism.reversals > 0 && reversals(candidate, along) < mechanism.reversals {
        return out;
    }
    let Some(law) = Law::new(setup, mechanism, candidate, along, cover) else { return out };
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
    /// Where it is wanted.
    cover: &'a Cover,
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
        cover: &'a Cover,
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
                    slopes.push((e, along.eval_on(cover, &[slope], &[])?.pop()?));
                }
            }
        }
        Some(Law { setup, mechanism, candidate, along, cover, change, marked, memory, slopes })
    }

    /// What the law does at these values of its own parameters.
    fn components(&self, values: &[f64]) -> Option<Vec<Component>> {
        let changes: Vec<Vec<Vec<f64>>> = match &self.memory {
            Some(recall) => {
                let mut law = recall.law(self.setup, values)?;
                for series in &mut law {
                    for (p, series) in series.iter_mut().enumerate() {
                        *series = self.cover.pick(p, series).unwrap_or_else(|| std::mem::take(series));
                    }
                }
                if self.mechanism.on.replaces() {
                    let base = self.candidate.base(&self.setup.model);
                    let base = self.along.eval_on(self.cover, &[base], &[])?.pop()?;
                    for (l, b) in law[0].iter_mut().flatten().zip(base.iter().flatten()) {
                        *l -= b;
                    }
                }
                law
            }
            None => {
                let extra: Vec<(&str, f64)> =
                    self.marked.iter().map(String::as_str).zip(values.iter().copied()).collect();
                self.along.eval_on(self.cover, &self.change, &extra)?
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
