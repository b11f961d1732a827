//! From recordings to the governing equations.

use std::sync::Arc;

use greybox_calibrate::{
    Data, FreeRun, HELD_OUT_SHARE, HoldoutSource, Score, Setup, SmoothedStates, Work, window_length,
};
use greybox_model::{Hold, Model, Unit};
use greybox_recording::Recording;

use crate::dead_time;
use crate::error::IdentifyError;
use crate::first::{First, Ground, first_estimates};
use crate::options::{DelayedState, Options};
use crate::output_error::{self, Refined, State};
use crate::precision::{self, Precision};
use crate::setting::{Setting, derivative, is_of_the_language};
use crate::structure::{DeadTime, Equation, Extra, Signal, Structure};
use crate::weak;

/// A chosen term.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundTerm {
    /// The term, without its coefficient.
    pub expression: String,
    /// Name of its coefficient in the model.
    pub parameter: String,
    /// Exponents of the variables, for a monomial.
    pub powers: Vec<(String, u32)>,
    /// The coefficient.
    pub value: f64,
    /// Its 95 % interval; none for a coefficient that sets the scale.
    pub ci95: Option<(f64, f64)>,
    /// Share of bootstrap replicates whose choice holds the term; none for terms that always stay.
    pub inclusion: Option<f64>,
}

/// A term that was left out although the recordings do not rule it out, or kept although they hardly
/// show it.
#[derive(Debug, Clone, PartialEq)]
pub struct DoubtfulTerm {
    /// The term.
    pub expression: String,
    /// Whether the model has it.
    pub chosen: bool,
    /// Share of bootstrap replicates that choose it.
    pub inclusion: f64,
}

/// One identified equation: Σ value × term = input.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundEquation {
    /// The state it governs.
    pub state: String,
    /// The input on its right.
    pub input: Option<String>,
    /// Its terms, the leading derivative first.
    pub terms: Vec<FoundTerm>,
    /// Terms in doubt.
    pub doubtful: Vec<DoubtfulTerm>,
}

/// How the order of the library was chosen.
#[derive(Debug, Clone, PartialEq)]
pub struct OrderChoice {
    /// The order of the chosen terms.
    pub chosen: usize,
    /// Criterion of `by_order`.
    pub criterion: &'static str,
    /// Its value for each order searched, summed over the equations.
    pub by_order: Vec<(usize, f64)>,
}

/// An identified delay.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundDelay {
    /// The delayed state.
    pub state: String,
    /// The delay, s.
    pub value: f64,
    /// Its 95 % interval.
    pub ci95: Option<(f64, f64)>,
    /// The Cramér–Rao bound of its standard deviation at the noise found, s.
    pub bound: Option<f64>,
    /// Gain of the feedback.
    pub gain: f64,
    /// Its interval, where it was estimated.
    pub gain_ci95: Option<(f64, f64)>,
    /// Correlation of delay and gain, where both were estimated.
    pub correlation: Option<f64>,
}

/// The identified dead time τ of an input u: every equation that u enters has u(t − τ).
#[derive(Debug, Clone, PartialEq)]
pub struct FoundDeadTime {
    /// The input.
    pub input: String,
    /// Name of τ in the model.
    pub parameter: String,
    /// τ, s.
    pub value: f64,
    /// Its 95 % interval, which does not go below zero; none where τ ended on the longest looked for.
    pub ci95: Option<(f64, f64)>,
    /// The Cramér–Rao bound of its standard deviation at the noise found, s.
    pub bound: Option<f64>,
    /// Longest τ looked for, s.
    pub longest: f64,
}

impl FoundDeadTime {
    /// Whether τ ended on the longest looked for.
    pub fn is_at_longest(&self) -> bool {
        self.value >= self.longest * (1.0 - 1e-6)
    }
}

/// Free runs over the recordings of one role.
#[derive(Debug, Clone)]
pub struct Role {
    /// The data.
    pub data: Arc<Data>,
    /// Simulation from the state estimated on the first quarter.
    pub run: FreeRun,
    /// Scores over all recordings.
    pub scores: Vec<Score>,
    /// Scores recording by recording.
    pub by_recording: Vec<Vec<Score>>,
}

/// Recordings that were read in blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Blocks {
    /// Blocks that the equations were fitted to.
    pub blocks: usize,
    /// Their samples.
    pub samples: usize,
    /// Samples of blocks that could not be followed (the model diverges on them, or a channel is missing).
    pub lost: usize,
    /// Passes over the recordings.
    pub passes: usize,
    /// Whether the last pass moved no coefficient by more than a tenth of its interval's half-width.
    pub settled: bool,
}

/// The identified equations.
#[derive(Debug, Clone)]
pub struct Identification {
    /// The model, in the model language.
    pub model: Model,
    /// Its equations with uncertainty.
    pub equations: Vec<FoundEquation>,
    /// The order of the library.
    pub order: OrderChoice,
    /// Delays.
    pub delays: Vec<FoundDelay>,
    /// Dead times of the inputs that were asked for and that enter an equation.
    pub dead_times: Vec<FoundDeadTime>,
    /// Inputs whose dead times were asked for but that enter no equation.
    pub without_effect: Vec<String>,
    /// Fit on the training recordings.
    pub train: Role,
    /// Fit on held-out recordings.
    pub holdout: Option<Role>,
    /// Their source.
    pub holdout_source: HoldoutSource,
    /// Window of the restarted simulations, s.
    pub window: f64,
    /// Noise over spread, per channel.
    pub noise_floor: Vec<f64>,
    /// Residual RMS over the noise estimated from the recordings, per channel.
    pub misfit: Vec<f64>,
    /// Rounds of choice and refit.
    pub rounds: usize,
    /// Number of shooting segments of the last fit; one per piece: an output-error fit of whole records.
    pub segments: usize,
    /// How the recordings were read, where in blocks.
    pub blocks: Option<Blocks>,
    /// The fits ended at their limit of work ([`Options::work`]).
    pub limited: bool,
    /// Seed.
    pub seed: u64,
}

/// Watches an identification. It never steers it, but may end it: by giving the work up, and by unwinding.
pub trait ProgressListener: Sync {
    /// The work begins; it may be [given up](Work::give_up), after which it ends soon.
    fn begins(&self, _work: &Arc<Work>) {}
    /// A stage begins.
    fn stage(&self, _name: &str) {}
}

/// Nobody watches.
#[derive(Debug, Clone, Copy, Default)]
pub struct Quiet;
impl ProgressListener for Quiet {}

/// Identifies the governing equations of `train`; `holdout` recordings are only simulated.
///
/// # Errors
/// [`IdentifyError`] when the request or the recordings do not allow it.
pub fn identify(
    train: &[Recording],
    holdout: &[Recording],
    options: &Options,
    listener: &dyn ProgressListener,
) -> Result<Identification, IdentifyError> {
    let (fit_on, held, source) = split(train, holdout);
    let found = search(&fit_on, options, listener)?;
    listener.stage("precision");
    let Search { structure, data, first, refined } = &found;
    let precision = precision::assess(structure, refined, &first.allowed, options);
    conclude(structure, data, refined, &precision, first, &held, source, options)
}

/// What the two estimates came to.
#[derive(Debug, Clone)]
pub(crate) struct Search {
    pub structure: Structure,
    pub data: Arc<Data>,
    pub first: First,
    pub refined: Refined,
}

/// The weak form, then the output error.
pub(crate) fn search(
    fit_on: &[Recording],
    options: &Options,
    listener: &dyn ProgressListener,
) -> Result<Search, IdentifyError> {
    let plain = structure(fit_on, options)?;
    let mut structures = if options.has_one_scale() { plain.scaled_together() } else { vec![plain] };
    let plain = &structures[0];
    let all = vec![true; plain.terms.len()];
    let ones: Vec<f64> = plain.terms.iter().map(|t| if t.optional { 0.0 } else { 1.0 }).collect();
    let whole = plain.model(&all, &ones, &plain.outside_values())?;
    let data = Arc::new(Data::new(&whole, fit_on)?);
    let open = structures.iter_mut().flat_map(|s| &mut s.dead_times).filter(|d| d.longest.is_infinite());
    open.for_each(|d| d.longest = reach(&data));
    let plain = &structures[0];
    let past = plain.unknown_past();
    let samples = data.pieces.iter().map(|p| p.len - ((past / p.dt).ceil() as usize).min(p.len)).sum();
    if plain.terms.len() * 4 > samples {
        return Err(IdentifyError::TooManyTerms { candidates: plain.terms.len(), samples });
    }
    if let Some(c) = data.spread.iter().position(|s| s.is_nan() || *s <= 0.0) {
        return Err(IdentifyError::Still { name: data.channels[c].name.clone() });
    }

    listener.stage("weak form");
    let smoothed_states = SmoothedStates::new(&whole, &data);
    let ground = Ground { model: &whole, data: &data, smoothed_states: &smoothed_states, options };
    let work = Arc::new(Work::within(options.work));
    listener.begins(&work);
    let mut proposed: Vec<(Structure, First)> = Vec::new();
    for structure in structures {
        let first = first_estimates(&structure, &ground)?;
        proposed.push((structure, first));
    }

    listener.stage("output error");
    let best = best_begun(proposed, &data, &work, options.work);
    let (structure, mut first, refined) = best.ok_or(IdentifyError::NoFit)?;
    let refined = output_error::refine(&structure, refined, &first.allowed);
    let (structure, refined) = match options.hold {
        None if !work.is_spent() => better_hold(structure, refined),
        _ => (structure, refined),
    };
    let (structure, refined) =
        output_error::with_inputs_of_strength_one(structure, refined, &mut first.allowed);
    let (structure, refined) = output_error::scaled_by_inputs(structure, refined, &mut first.allowed);
    Ok(Search { structure, data, first, refined })
}

/// The longest dead time looked for where none is stated, s: a typical oscillation, at most a tenth of the longest stretch.
fn reach(data: &Data) -> f64 {
    let longest = data.pieces.iter().map(|p| p.len as f64 * p.dt).fold(0.0, f64::max);
    weak::period(data).min(0.1 * longest)
}

fn split(train: &[Recording], holdout: &[Recording]) -> (Vec<Recording>, Vec<Recording>, HoldoutSource) {
    if !holdout.is_empty() {
        return (train.to_vec(), holdout.to_vec(), HoldoutSource::Given);
    }
    let (head, tail) = Data::split_tail(train, HELD_OUT_SHARE);
    if head.len() == train.len() {
        (head, tail, HoldoutSource::LastFifth)
    } else {
        (train.to_vec(), Vec::new(), HoldoutSource::None)
    }
}

/// The candidates that a request describes, with names and units from the recordings.
pub(crate) fn structure(recordings: &[Recording], options: &Options) -> Result<Structure, IdentifyError> {
    if options.states.is_empty() {
        return Err(IdentifyError::NoStates);
    }
    if options.derivatives.len() != options.states.len() {
        return Err(IdentifyError::Derivatives {
            given: options.derivatives.len(),
            states: options.states.join(", "),
        });
    }
    if let Some(found) = options.derivatives.iter().find(|order| !(1..=2).contains(*order)) {
        let found = *found as f64;
        return Err(IdentifyError::Range {
            what: "the order of the leading derivative",
            found,
            range: "1 to 2",
        });
    }
    if !(1..=12).contains(&options.order) {
        let found = options.order as f64;
        return Err(IdentifyError::Range { what: "the order of the library", found, range: "1 to 12" });
    }
    let roles =
        options.states.iter().map(|s| (s, "state")).chain(options.inputs.iter().map(|s| (s, "input")));
    let mut seen: Vec<(&String, &'static str)> = Vec::new();
    for (name, role) in roles {
        if let Some((_, first)) = seen.iter().find(|(n, _)| *n == name) {
            return Err(IdentifyError::Twice { name: name.clone(), first, second: role });
        }
        check_name(name)?;
        seen.push((name, role));
    }
    let unit = |name: &str| recordings.iter().flat_map(|r| r.channel(name)).find_map(|c| c.unit.clone());
    let signal = |name: &String| Signal { name: name.clone(), unit: unit(name) };
    let hold = options.hold.unwrap_or(Hold::Linear);
    for term in &options.library.terms {
        check_term(term, options)?;
    }
    // The only input drives the only equation, and a delayed feedback acts beside an input that is known to be there.
    let fixed = options.delay.is_some() || (options.states.len() == 1 && options.inputs.len() == 1);
    let right = if fixed { options.inputs.first() } else { None };
    let mut taken: Vec<String> = options.states.iter().chain(&options.inputs).cloned().collect();
    taken.extend(["t", "pi", "tau", "kp"].map(String::from));
    // A unit that cannot be read is reported where the recordings are laid out.
    let may_be_angle = |state: &String| {
        unit(state).and_then(|text| Unit::parse(&text).ok()).is_none_or(|unit| unit.dimension.is_none())
    };
    let angles: Vec<bool> = options.states.iter().map(may_be_angle).collect();
    if (options.library.trigonometric || options.library.lagrangian) && !angles.contains(&true) {
        return Err(IdentifyError::NoAngle { states: options.states.join(", ") });
    }
    let mut setting = Setting {
        states: &options.states,
        derivatives: &options.derivatives,
        inputs: &options.inputs[usize::from(right.is_some())..],
        orders: options.order,
        angles,
        taken,
    };
    let lengths = recordings.iter().flat_map(|r| &r.pieces).map(|p| p.len as f64 * p.dt);
    let recorded = lengths.fold(0.0, f64::max);
    dead_time::check(options, recorded)?;
    let dead_times = options
        .dead_times
        .iter()
        .map(|d| DeadTime {
            input: d.input.clone(),
            parameter: setting.name(format!("tau_{}", d.input)),
            longest: d.longest.unwrap_or(f64::INFINITY),
        })
        .collect();
    let terms = options.library.terms(&mut setting);
    let extras = options.delay.iter().map(|delay| feedback(delay, options, recorded));
    let extras = extras.collect::<Result<Vec<Extra>, IdentifyError>>()?;
    let files: Vec<&str> = recordings.iter().map(|r| r.name.as_str()).collect();
    Ok(Structure {
        title: format!("identified from {}", files.join(", ")),
        inputs: options.inputs.iter().map(|n| (signal(n), hold)).collect(),
        states: options.states.iter().map(signal).collect(),
        equations: options
            .states
            .iter()
            .map(|s| Equation {
                name: format!("motion_{s}"),
                input: right.cloned(),
                normalised: right.is_none(),
            })
            .collect(),
        terms,
        extras,
        dead_times,
    })
}

/// A delayed feedback beside the input of every equation; `recorded` is the longest stretch without a gap, s.
fn feedback(delay: &DelayedState, options: &Options, recorded: f64) -> Result<Extra, IdentifyError> {
    if !options.states.contains(&delay.state) {
        let (name, states) = (delay.state.clone(), options.states.join(", "));
        return Err(IdentifyError::DelayedState { name, states });
    }
    if options.inputs.is_empty() {
        return Err(IdentifyError::DelayWithoutInput);
    }
    if !(delay.longest > 0.0 && delay.longest.is_finite()) {
        let found = delay.longest;
        return Err(IdentifyError::Range { what: "the longest delay", found, range: "(0, ∞) s" });
    }
    if let Some(found) = delay.gain.filter(|gain| !gain.is_finite()) {
        let (what, range) = ("the gain of the delayed feedback", "the finite numbers");
        return Err(IdentifyError::Range { what, found, range });
    }
    if options.has_one_scale() {
        return Err(IdentifyError::DelayWithEnergies);
    }
    if delay.longest >= recorded {
        return Err(IdentifyError::LongestDelay { longest: delay.longest, recorded });
    }
    Ok(Extra {
        expression: format!("-kp*delay({}, tau)", delay.state),
        parameters: vec![
            ("kp".to_string(), delay.gain.unwrap_or(1.0), delay.gain.is_some()),
            ("tau".to_string(), 0.25 * delay.longest, false),
        ],
    })
}

fn check_name(name: &str) -> Result<(), IdentifyError> {
    let wrong = |reason: String| IdentifyError::Name { name: name.to_string(), reason };
    if is_of_the_language(name) {
        return Err(wrong("the language has another meaning for it".to_string()));
    }
    match greybox_model::parse(name) {
        Ok(parsed) if matches!(&parsed.expr, greybox_model::Expr::Var { name: n, primes: 0 } if **n == *name) => {
            Ok(())
        }
        Ok(_) => {
            Err(wrong("names have letters, digits and underscores, and begin with a letter".to_string()))
        }
        Err(e) => Err(wrong(e.to_string())),
    }
}

fn check_term(term: &str, options: &Options) -> Result<(), IdentifyError> {
    let wrong = |reason: String| IdentifyError::Term { term: term.to_string(), reason };
    let parsed = greybox_model::parse(term).map_err(|e| wrong(e.to_string()))?;
    let variables = parsed.expr.variables();
    for (name, primes) in &variables {
        let state = options.states.iter().position(|s| **s == **name);
        let is_input = options.inputs.iter().any(|s| **s == **name);
        if state.is_none() && !is_input {
            let known: Vec<String> = options.states.iter().chain(&options.inputs).cloned().collect();
            return Err(wrong(format!(
                "`{name}` is neither a state nor an input (there are {})",
                known.join(", ")
            )));
        }
        let most = state.map_or(1, |s| options.derivatives[s]);
        if usize::from(*primes) >= most {
            let reached = derivative(name, usize::from(*primes));
            return Err(wrong(format!("`{reached}` is a derivative that no term of the library may have")));
        }
    }
    if variables.is_empty() {
        return Err(IdentifyError::ConstantTerm { term: term.to_string() });
    }
    Ok(())
}

/// Inclusion probability from which a term is in doubt, and its complement.
const DOUBT: f64 = 0.05;

/// A start whose simulations cost so many times as much as another's has a model that can hardly be simulated.
const HARD: u64 = 10;

/// The best first fit of all structures' starts; each does at most a part of half of the work.
fn best_begun(
    proposed: Vec<(Structure, First)>,
    data: &Arc<Data>,
    work: &Arc<Work>,
    most: u64,
) -> Option<(Structure, First, Refined)> {
    let count: usize = proposed.iter().map(|(_, first)| first.starts.len()).sum();
    let mut most = most / (2 * count.max(1) as u64);
    let mut best: Option<(usize, Refined)> = None;
    for (k, (structure, first)) in proposed.iter().enumerate() {
        for start in &first.starts {
            let before = work.done();
            let part = Work::part_of(work, most);
            let Some(refined) = output_error::begin(structure, data, start.clone(), part) else { continue };
            // As if the fit had taken all of its steps.
            let step = (work.done() - before) / (refined.fit.iterations as u64 + 1);
            most = most.min(HARD * (output_error::FIRST_STEPS as u64 + 1) * step.max(1));
            if best.as_ref().is_none_or(|(_, b)| refined.score() < b.score()) {
                best = Some((k, refined));
            }
        }
    }
    let (k, mut refined) = best?;
    refined.setup.work = work.clone();
    let (structure, first) = proposed.into_iter().nth(k)?;
    Some((structure, first, refined))
}

/// The hold of the inputs that fits best, where the difference is beyond chance.
fn better_hold(structure: Structure, refined: Refined) -> (Structure, Refined) {
    if structure.inputs.is_empty() {
        return (structure, refined);
    }
    let mut best: Option<(f64, Structure, Refined)> = None;
    for hold in [Hold::Zero, Hold::BandLimited] {
        let mut other = structure.clone();
        other.inputs.iter_mut().for_each(|i| i.1 = hold);
        let Some(next) = output_error::refit(&other, &refined) else { continue };
        // Twice the gain in log-likelihood; 10 is far beyond what one choice of three gives by chance.
        let gain = refined.score() - next.score();
        if gain > 10.0 && best.as_ref().is_none_or(|b| gain > b.0) {
            best = Some((gain, other, next));
        }
    }
    match best {
        Some((_, structure, refined)) => (structure, refined),
        None => (structure, refined),
    }
}

pub(crate) fn conclude(
    structure: &Structure,
    data: &Arc<Data>,
    refined: &Refined,
    precision: &Precision,
    first: &First,
    held: &[Recording],
    source: HoldoutSource,
    options: &Options,
) -> Result<Identification, IdentifyError> {
    let state = &refined.state;
    let mut model = structure.model(&state.active, &state.values, &state.extras)?;
    model.resolve_units()?;
    let durations: Vec<f64> = data.pieces.iter().map(|p| p.len as f64 * p.dt).collect();
    let dt = data.pieces.iter().map(|p| p.dt).fold(f64::INFINITY, f64::min);
    let window = window_length(&durations, dt);
    let role = |data: Arc<Data>| -> Option<Role> {
        let mut setup = Setup::new(&model, data.clone(), Vec::new()).ok()?;
        setup.method = refined.setup.method;
        let values = setup.values();
        let run = setup.free_run(&values, &refined.scale);
        let scores = setup.scores(&run, &values, window, None);
        let by_recording =
            (0..data.recordings.len()).map(|r| setup.scores(&run, &values, window, Some(r))).collect();
        Some(Role { data, run, scores, by_recording })
    };
    let train = role(data.clone()).ok_or(IdentifyError::NoFit)?;
    let holdout = if held.is_empty() { None } else { role(Arc::new(Data::new(&model, held)?)) };
    let equations = structure
        .equations
        .iter()
        .enumerate()
        .map(|(e, equation)| {
            let of_equation =
                || structure.terms.iter().enumerate().filter_map(|(i, t)| Some((i, t, t.part(e)?)));
            let terms = of_equation()
                .filter(|(i, ..)| state.active[*i])
                .map(|(i, t, part)| FoundTerm {
                    expression: structure.late(&part.expression),
                    parameter: t.parameter.clone(),
                    powers: t.powers.clone(),
                    value: state.values[i],
                    ci95: precision.interval(i, state.values[i]),
                    inclusion: if t.optional { precision.inclusion.get(i).copied() } else { None },
                })
                .collect();
            let mut terms: Vec<FoundTerm> = terms;
            if let Some(delay) = &options.delay {
                let gain = state.extras[0];
                terms.push(FoundTerm {
                    expression: format!("delay({}, tau)", delay.state),
                    parameter: "kp".to_string(),
                    powers: Vec::new(),
                    value: -gain,
                    ci95: precision.extra_interval(0, gain).map(|(a, b)| (-b, -a)),
                    inclusion: None,
                });
            }
            let doubtful = of_equation()
                .filter(|(_, t, _)| t.optional)
                .filter_map(|(i, _, part)| {
                    let inclusion = *precision.inclusion.get(i)?;
                    (inclusion > DOUBT && inclusion < 1.0 - DOUBT).then(|| DoubtfulTerm {
                        expression: structure.late(&part.expression),
                        chosen: state.active[i],
                        inclusion,
                    })
                })
                .collect();
            FoundEquation { state: options.states[e].clone(), input: equation.input.clone(), terms, doubtful }
        })
        .collect();
    let delays = options
        .delay
        .iter()
        .map(|d| FoundDelay {
            state: d.state.clone(),
            value: state.extras[1],
            ci95: precision.extra_interval(1, state.extras[1]),
            bound: precision.extra_bound(1),
            gain: state.extras[0],
            gain_ci95: precision.extra_interval(0, state.extras[0]),
            correlation: precision.extra_correlation,
        })
        .collect();
    let dead_times = dead_times(structure, &model, state, precision);
    let chosen = structure
        .terms
        .iter()
        .zip(&state.active)
        .filter(|(t, a)| **a && t.optional)
        .map(|(t, _)| t.order)
        .max()
        .unwrap_or(0);
    Ok(Identification {
        equations,
        order: OrderChoice { chosen, criterion: "aic", by_order: first.by_order.clone() },
        delays,
        without_effect: structure
            .dead_times
            .iter()
            .filter(|d| dead_times.iter().all(|found| found.input != d.input))
            .map(|d| d.input.clone())
            .collect(),
        dead_times,
        noise_floor: data.sigma.iter().zip(&data.spread).map(|(s, d)| s / d).collect(),
        misfit: refined.scale.iter().zip(&data.sigma).map(|(r, s)| r / s).collect(),
        rounds: refined.rounds,
        segments: refined.level.segments.len(),
        blocks: None,
        limited: refined.setup.work.is_spent(),
        seed: options.seed,
        model,
        train,
        holdout,
        holdout_source: source,
        window,
    })
}

/// The dead times of the inputs that enter an equation.
fn dead_times(
    structure: &Structure,
    model: &Model,
    state: &State,
    precision: &Precision,
) -> Vec<FoundDeadTime> {
    let first = structure.first_dead_time();
    let enters = |d: &DeadTime| model.parameter(&d.parameter).is_some();
    let those = structure.dead_times.iter().enumerate().filter(|(_, d)| enters(d));
    those
        .map(|(i, d)| {
            let value = state.extras[first + i];
            let found = FoundDeadTime {
                input: d.input.clone(),
                parameter: d.parameter.clone(),
                value,
                ci95: None,
                bound: precision.extra_bound(first + i),
                longest: d.longest,
            };
            let ci95 = precision.extra_interval(first + i, value).map(|(low, high)| (low.max(0.0), high));
            FoundDeadTime { ci95: ci95.filter(|_| !found.is_at_longest()), ..found }
        })
        .collect()
}
