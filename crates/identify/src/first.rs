//! First estimates, from which the output error starts: the weak form's choice of terms, at the delays that explain best.

use std::rc::Rc;

use greybox_calibrate::{Data, SmoothedStates};
use greybox_model::Model;
use greybox_sparse::{folds, select};

use crate::choose::Roles;
use crate::dead_time::{Axis, lowest};
use crate::error::IdentifyError;
use crate::options::Options;
use crate::output_error::State;
use crate::structure::Structure;
use crate::weak;

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

/// Window lengths of the weak form, in typical oscillations.
const WINDOWS: [f64; 3] = [0.3, 0.6, 1.2];

/// What the first estimates are made from.
pub(crate) struct Ground<'a> {
    /// The model with all candidates, for its layout.
    pub model: &'a Model,
    pub data: &'a Data,
    pub smoothed_states: &'a SmoothedStates,
    pub options: &'a Options,
}

impl Ground<'_> {
    /// The signals of the weak form with these dead times.
    fn signals(&self, structure: &Structure, dead_times: &[f64]) -> Option<weak::Signals<'_>> {
        let mut late = vec![0.0; self.model.inputs.len()];
        for (dead_time, value) in structure.dead_times.iter().zip(dead_times) {
            if let Some(input) = self.model.input(&dead_time.input) {
                late[input] = *value;
            }
        }
        let past = structure.unknown_past();
        weak::evaluate(structure, self.model, weak::stretches(self.data, self.smoothed_states, &late, past))
    }

    /// Smallest sample interval, s.
    fn step(&self) -> f64 {
        self.data.pieces.iter().map(|p| p.dt).fold(f64::INFINITY, f64::min)
    }

    /// Length of the longest piece that the weak form sees, s.
    fn longest(&self, structure: &Structure) -> f64 {
        let past = structure.unknown_past();
        self.data.pieces.iter().map(|p| p.len as f64 * p.dt - past).fold(0.0, f64::max)
    }
}

/// One window length with the signals that it is applied to.
struct Windowed<'a> {
    length: f64,
    dead_times: Vec<f64>,
    signals: Rc<weak::Signals<'a>>,
}

/// The three window lengths; where inputs have dead times, each with those that it explains best.
fn windowed<'a>(structure: &Structure, ground: &'a Ground<'_>) -> Option<Vec<Windowed<'a>>> {
    let period = weak::period(ground.data);
    let (step, longest) = (ground.step(), ground.longest(structure));
    let length = |share: f64| (share * period).min(0.2 * longest).max(16.0 * step);
    let prompt = vec![0.0; structure.dead_times.len()];
    let signals = Rc::new(ground.signals(structure, &prompt)?);
    if prompt.is_empty() {
        let all = WINDOWS.map(|share| (length(share), prompt.clone(), signals.clone()));
        return Some(
            all.map(|(length, dead_times, signals)| Windowed { length, dead_times, signals }).into(),
        );
    }
    let everything = vec![true; structure.terms.len()];
    let axes: Vec<Axis> = structure
        .dead_times
        .iter()
        .map(|d| Axis {
            longest: d.longest,
            coarse: (d.longest / 16.0).min(period / 8.0).max(step),
            fine: 0.25 * step,
        })
        .collect();
    WINDOWS
        .iter()
        .map(|share| {
            let length = length(*share);
            let mut criterion = |dead_times: &[f64]| {
                let signals = ground.signals(structure, dead_times)?;
                Some(estimate(structure, ground.model, &signals, length, None, &everything)?.0)
            };
            let dead_times = lowest(&axes, &mut criterion);
            let signals = Rc::new(ground.signals(structure, &dead_times)?);
            Some(Windowed { length, dead_times, signals })
        })
        .collect()
}

/// The weak form's choice of terms and first values.
///
/// # Errors
/// [`IdentifyError::TooShort`] where the pieces are shorter than a window, [`IdentifyError::NoFit`] where a candidate cannot be
/// evaluated.
pub(crate) fn first_estimates(structure: &Structure, ground: &Ground<'_>) -> Result<First, IdentifyError> {
    let Ground { model, options, .. } = *ground;
    let windowed = windowed(structure, ground).ok_or(IdentifyError::NoFit)?;
    let everything = vec![true; structure.terms.len()];
    let trials = trials(options);
    let best = |allowed: &[bool]| -> Vec<(f64, State)> {
        let mut starts: Vec<(f64, State)> = windowed
            .iter()
            .flat_map(|w| trials.iter().map(move |t| (w, *t)))
            .filter_map(|(w, trial)| {
                let (badness, mut state) = estimate(structure, model, &w.signals, w.length, trial, allowed)?;
                state.extras[structure.first_dead_time()..].copy_from_slice(&w.dead_times);
                Some((badness, state))
            })
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
    let by_order = order_search(structure, model, &windowed[1], trial, options);
    let chosen = by_order.iter().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(options.order, |o| o.0);
    // One order more than the first estimate asks for: its errors hide weak terms.
    let allowed: Vec<bool> = structure.terms.iter().map(|t| t.order <= chosen + 1).collect();
    let starts: Vec<State> = best(&allowed).into_iter().map(|s| s.1).collect();
    if starts.is_empty() {
        return Err(IdentifyError::TooShort {
            samples: (ground.longest(structure) / ground.step()) as usize,
        });
    }
    Ok(First { starts, allowed, by_order })
}

/// Thesis Algorithm 1 on the weak form: AIC on the second half of the windows for every order of the library, summed
/// over the equations.
fn order_search(
    structure: &Structure,
    model: &Model,
    windowed: &Windowed<'_>,
    trial: Option<weak::Trial>,
    options: &Options,
) -> Vec<(usize, f64)> {
    let Windowed { length, signals, .. } = windowed;
    let mut total: Vec<(usize, f64)> = (1..=options.order).map(|n| (n, 0.0)).collect();
    for group in structure.groups() {
        let rows = group.iter().map(|&e| weak::rows(structure, model, signals, e, *length, trial));
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
    signals: &weak::Signals<'_>,
    window: f64,
    trial: Option<weak::Trial>,
    allowed: &[bool],
) -> Option<(f64, State)> {
    let mut state = State {
        active: structure.terms.iter().map(|t| !t.optional).collect(),
        values: structure.terms.iter().map(|t| if t.optional { 0.0 } else { 1.0 }).collect(),
        extras: structure.outside_values(),
    };
    let mut badness = 0.0;
    for group in structure.groups() {
        let rows = group.iter().map(|&e| weak::rows(structure, model, signals, e, window, trial));
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
