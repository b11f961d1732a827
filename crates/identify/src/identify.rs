//! From recordings to the governing equations.

use std::sync::Arc;

use greybox_calibrate::{
    Data, FreeRun, HELD_OUT_SHARE, HoldoutSource, Score, Setup, SmoothedStates, Work, window_length,
};
use greybox_model::{Hold, Model, Unit};
use greybox_recording::Recording;
use greybox_sparse::{folds, select};

use crate::choose::Roles;
use crate::error::IdentifyError;
use crate::options::Options;
use crate::output_error::{self, Refined, State};
use crate::precision::{self, Precision};
use crate::setting::{Setting, derivative, is_of_the_language};
use crate::structure::{Equation, Extra, Signal, Structure};
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
    let structures = if options.has_one_scale() { plain.scaled_together() } else { vec![plain] };
    let plain = &structures[0];
    let all = vec![true; plain.terms.len()];
    let ones: Vec<f64> = plain.terms.iter().map(|t| if t.optional { 0.0 } else { 1.0 }).collect();
    let extras: Vec<f64> = plain.extras.iter().flat_map(|e| &e.parameters).map(|p| p.1).collect();
    let whole = plain.model(&all, &ones, &extras)?;
    let data = Arc::new(Data::new(&whole, fit_on)?);
    let samples = data.samples();
    if plain.terms.len() * 4 > samples {
        return Err(IdentifyError::TooManyTerms { candidates: plain.terms.len(), samples });
    }
    if let Some(c) = data.spread.iter().position(|s| s.is_nan() || *s <= 0.0) {
        return Err(IdentifyError::Still { name: data.channels[c].name.clone() });
    }

    listener.stage("weak form");
    let smoothed_states = SmoothedStates::new(&whole, &data);
    let values = weak::evaluate(plain, &whole, &data, &smoothed_states).ok_or(IdentifyError::NoFit)?;
    let work = Arc::new(Work::within(options.work));
    listener.begins(&work);
    let mut proposed: Vec<(Structure, First)> = Vec::new();
    for structure in structures {
        let first = first_estimates(&structure, &whole, &data, &values, options)?;
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
    // A unit that cannot be read is told where the recordings are laid out.
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
    let terms = options.library.terms(&mut setting);
    let mut extras = Vec::new();
    if let Some(delay) = &options.delay {
        if !options.states.contains(&delay.state) {
            return Err(IdentifyError::DelayedState {
                name: delay.state.clone(),
                states: options.states.join(", "),
            });
        }
        if options.inputs.is_empty() {
            return Err(IdentifyError::DelayWithoutInput);
        }
        if !(delay.longest > 0.0 && delay.longest.is_finite()) {
            let found = delay.longest;
            return Err(IdentifyError::Range { what: "the longest delay", found, range: "(0, ∞) s" });
        }
        if let Some(found) = delay.gain.filter(|gain| !gain.is_finite()) {
            return Err(IdentifyError::Range {
                what: "the gain of the delayed feedback",
                found,
                range: "the finite numbers",
            });
        }
        if options.has_one_scale() {
            return Err(IdentifyError::DelayWithEnergies);
        }
        let lengths = recordings.iter().flat_map(|r| &r.pieces).map(|p| p.len as f64 * p.dt);
        let recorded = lengths.fold(0.0, f64::max);
        if delay.longest >= recorded {
            return Err(IdentifyError::LongestDelay { longest: delay.longest, recorded });
        }
        extras.push(Extra {
            expression: format!("-kp*delay({}, tau)", delay.state),
            parameters: vec![
                ("kp".to_string(), delay.gain.unwrap_or(1.0), delay.gain.is_some()),
                ("tau".to_string(), 0.25 * delay.longest, false),
            ],
        });
    }
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

/// What the weak form says.
#[derive(Debug, Clone)]
pub(crate) struct First {
    /// Starting points, one per window length.
    pub starts: Vec<State>,
    /// Candidates that the output error may choose from.
    pub allowed: Vec<bool>,
    /// Criterion by order.
    pub by_order: Vec<(usize, f64)>,
}

/// Inclusion probability from which a term is in doubt, and its complement.
const DOUBT: f64 = 0.05;

/// Window lengths of the weak form, in typical oscillations.
const WINDOWS: [f64; 3] = [0.3, 0.6, 1.2];

fn first_estimates(
    structure: &Structure,
    model: &Model,
    data: &Data,
    values: &weak::Values,
    options: &Options,
) -> Result<First, IdentifyError> {
    let period = weak::period(data);
    let longest = data.pieces.iter().map(|p| p.len).max().unwrap_or(0);
    let dt = data.pieces.iter().map(|p| p.dt).fold(f64::INFINITY, f64::min);
    let window = |share: f64| (share * period).clamp(16.0 * dt, 0.2 * longest as f64 * dt);
    let everything = vec![true; structure.terms.len()];
    let trials = trials(options);
    let best = |allowed: &[bool]| -> Vec<(f64, State)> {
        let mut starts: Vec<(f64, State)> = WINDOWS
            .iter()
            .flat_map(|share| trials.iter().map(move |t| (window(*share), *t)))
            .filter_map(|(window, trial)| estimate(structure, model, data, values, window, trial, allowed))
            .collect();
        // Without a delay one start per window; with one, the most probable delays.
        if !structure.extras.is_empty() {
            starts.sort_by(|a, b| a.0.total_cmp(&b.0));
            starts.truncate(WINDOWS.len());
        }
        starts
    };
    let trial = match trials.as_slice() {
        [None] => None,
        _ => best(&everything)
            .first()
            .and_then(|s| trials[0].map(|t| weak::Trial { delay: s.1.extras[1], ..t })),
    };
    let by_order = order_search(structure, model, data, values, window(WINDOWS[1]), trial, options);
    let chosen = by_order.iter().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(options.order, |o| o.0);
    // One order more than the first estimate asks for: its errors hide weak terms.
    let allowed: Vec<bool> = structure.terms.iter().map(|t| t.order <= chosen + 1).collect();
    let starts: Vec<State> = best(&allowed).into_iter().map(|s| s.1).collect();
    if starts.is_empty() {
        return Err(IdentifyError::TooShort { samples: longest });
    }
    Ok(First { starts, allowed, by_order })
}

/// Thesis Algorithm 1 on the weak form: AIC on the second half of the windows for every order of the library, summed
/// over the equations.
fn order_search(
    structure: &Structure,
    model: &Model,
    data: &Data,
    values: &weak::Values,
    window: f64,
    trial: Option<weak::Trial>,
    options: &Options,
) -> Vec<(usize, f64)> {
    let mut total: Vec<(usize, f64)> = (1..=options.order).map(|n| (n, 0.0)).collect();
    for group in structure.groups() {
        let rows = group.iter().map(|&e| weak::rows(structure, model, data, values, e, window, trial));
        let Some(rows) = rows.collect::<Option<Vec<weak::Rows>>>() else { continue };
        let weak::Regression { target, columns, protected } =
            weak::regression(structure, &rows, trial.and_then(|t| t.gain));
        let overlap = rows.iter().map(|r| r.overlap).max().unwrap_or(1);
        let mut pieces = Vec::new();
        let mut from = 0;
        for rows in &rows {
            pieces.extend(rows.pieces.iter().map(|p| from + p.start..from + p.end));
            from += rows.target.len();
        }
        let views: Vec<&[f64]> = columns.iter().map(|c| c.1.as_slice()).collect();
        let sizes: Vec<usize> = (1..=options.order)
            .map(|n| columns.iter().filter(|c| c.0.is_none_or(|t| structure.terms[t].order <= n)).count())
            .collect();
        let settings = select::Options {
            folds: 5,
            gap: overlap,
            sample_size: select::SampleSize::Effective,
            ..select::Options::normalised()
        };
        // Too many columns for the windows there are: the orders below are still searched.
        let mut last = sizes.len();
        while last > 0 {
            let found = greybox_sparse::Rows::new(&views[..sizes[last - 1]], &target)
                .and_then(|table| {
                    let split = folds::train_test(&pieces, 0.5, overlap)?;
                    select::Problem::new(table, &sizes[..last], &protected, split)
                })
                .and_then(|problem| select::search(&problem, &settings));
            if let Ok(search) = found {
                for (sum, order) in total.iter_mut().zip(&search.orders) {
                    sum.1 += order.aic;
                }
                break;
            }
            last -= 1;
        }
        total.truncate(last);
    }
    total
}

/// Delays to try, where one is asked for.
fn trials(options: &Options) -> Vec<Option<weak::Trial>> {
    const DELAYS: usize = 16;
    let Some(delay) = &options.delay else { return vec![None] };
    let state = options.states.iter().position(|s| *s == delay.state).unwrap_or(0);
    (1..=DELAYS)
        .map(|i| {
            let share = i as f64 / DELAYS as f64;
            Some(weak::Trial { state, delay: share * delay.longest, gain: delay.gain })
        })
        .collect()
}

/// The weak form's choice with windows of one length, and how well it does.
fn estimate(
    structure: &Structure,
    model: &Model,
    data: &Data,
    values: &weak::Values,
    window: f64,
    trial: Option<weak::Trial>,
    allowed: &[bool],
) -> Option<(f64, State)> {
    let mut state = State {
        active: structure.terms.iter().map(|t| !t.optional).collect(),
        values: structure.terms.iter().map(|t| if t.optional { 0.0 } else { 1.0 }).collect(),
        extras: structure.extras.iter().flat_map(|e| &e.parameters).map(|p| p.1).collect(),
    };
    let mut badness = 0.0;
    for group in structure.groups() {
        let rows = group.iter().map(|&e| weak::rows(structure, model, data, values, e, window, trial));
        let rows: Vec<weak::Rows> = rows.collect::<Option<_>>()?;
        let gain = trial.and_then(|t| t.gain);
        let (reduced, terms) = weak::reduce(structure, &rows, gain);
        let solution = reduced.choose(&Roles::new(&terms, &structure.terms, allowed));
        badness += reduced.samples * (solution.rss / reduced.samples).ln()
            + solution.columns.len() as f64 * reduced.samples.ln();
        for (&c, &v) in solution.columns.iter().zip(&solution.values) {
            match terms[c] {
                Some(t) => {
                    state.active[t] = true;
                    state.values[t] = v;
                }
                // The delayed state stands on the left as −k_p.
                None => state.extras[0] = -v,
            }
        }
        if let Some(t) = trial {
            state.extras[1] = t.delay;
        }
    }
    Some((badness, state))
}

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
                    expression: part.expression.clone(),
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
                        expression: part.expression.clone(),
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
