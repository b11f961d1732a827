//! Which laws a machine lacks, where its model errs whatever is added: hypotheses with a model error of their own, compared
//! by their posterior probability.
//!
//! A hypothesis is a set of laws beside the machine's equations. Its likelihood is the composite one of
//! [`greybox_calibrate::stochastic`], in which every equation of the machine may err by a random force. Its evidence is
//! Laplace's, with the likelihood tempered by the inflation c, since samples tell of each other:
//!
//! ```text
//! ln Z = ln L/c + ln π(p̂) − ½ ln |I/c + Λ| + ½ n ln 2π − k ln N
//! ```
//!
//! | part | prior |
//! |---|---|
//! | a law | one of the N candidates: 1/N each |
//! | a strength | normal about zero, as wide as the strength whose force is all the force that the equation has |
//! | an inner parameter | even in its logarithm between the bounds of its file |
//! | a parameter of the machine | as stated, or Cauchy about its value ([`greybox_calibrate::free_parameters`]) |
//! | ln q, ln r | even over the range that a fit may use |

mod beside;

use std::f64::consts::PI;
use std::ops::Range;
use std::sync::Arc;

use greybox_calibrate::stochastic::{Filter, Fitted as Filtered, Pass, RANGE, Stochastic};
use greybox_calibrate::{FitPoint, Point, Prior, Segmentation, Setup, Work, qr};
use greybox_simulate::SignalLanes;
use rayon::prelude::*;

use self::beside::Beside;
use crate::candidate::Candidate;
use crate::fitted::{FittedModel, Law, MechanismTerm, laws};
use crate::library::First;
use crate::marginal::log_sum;
use crate::screen::{CandidateResponses, Gram, Scored, first_states, lanes, scored};
use crate::search::{Search, carried};
use crate::spectra::Spectra;
use crate::trajectory::{Cover, TrajectoryEval};
use crate::{ProgressListener, Stage};

/// Probability from which a family of laws is named.
const NAMED: f64 = 0.95;
/// Difference of two logarithms of evidence up to which the data do not decide. (A score is twice such a logarithm.)
const UNDECIDED: f64 = 0.5 * crate::search::UNDECIDED;
/// Hypotheses of each number of laws that are followed.
const BEAM: usize = 2;
/// Most laws.
const MOST: usize = 4;
/// Most candidates that are fitted to each hypothesis, and of these to the end.
const SHORT_LIST: usize = 9;
const FINALISTS: usize = 5;
/// Steps that tell which these are, further steps that tell which of them go to the end, how many do, and the steps of their
/// fits.
const FIRST_STEPS: usize = 2;
const MORE_STEPS: usize = 6;
const BEST: usize = 2;
const LAST_STEPS: usize = 25;
/// Steps of the fit of the machine's own equations, and rounds of doubt.
const CALIBRATION: usize = 40;
const ROUNDS: usize = 3;
/// The work of a search over that of an exploration.
const SHARE_OF_WORK: u64 = 4;
/// Gain in nats that a candidate must promise to be fitted.
const PROMISING: f64 = 1.0;
/// Departure of a parameter from what is stated, in units of its prior, from which candidates are also tried where it is
/// stated: a calibrated parameter may stand in for what is missing.
const FAR_FROM_STATED: f64 = 1.0;
/// The least value of an inner parameter that its prior reaches, over its highest.
const LEAST: f64 = 1e-3;
/// Segments along which candidates are evaluated.
const SEGMENTS: usize = 20;

/// What is known of a law's parameter before the data.
#[derive(Debug, Clone, PartialEq)]
enum Known {
    /// Normal about zero, with this deviation.
    Strength(f64),
    /// Its logarithm is even over so much.
    Inner(f64),
    /// An angle.
    Angle,
}

/// The machine's equations with some laws, fitted.
#[derive(Debug, Clone)]
pub(crate) struct Hypothesis {
    /// The laws as they stand in the model.
    pub(crate) parts: Vec<MechanismTerm>,
    /// What is known of the parameters of each before the data.
    known: Vec<Vec<Known>>,
    /// The fit.
    pub(crate) fitted: Filtered,
}

/// A hypothesis to be fitted.
struct Draft {
    parts: Vec<MechanismTerm>,
    known: Vec<Vec<Known>>,
    start: Stochastic,
}

impl Hypothesis {
    fn candidates(&self) -> impl Iterator<Item = &Candidate> {
        self.parts.iter().map(|part| &part.candidate)
    }

    fn holds(&self, candidate: &Candidate) -> bool {
        self.candidates().any(|c| c == candidate)
    }

    /// Whether it has these laws and no others.
    fn is(&self, candidates: &[&Candidate]) -> bool {
        self.parts.len() == candidates.len() && candidates.iter().all(|c| self.holds(c))
    }

    /// Its laws with their present values.
    fn laws(&self) -> Vec<Law> {
        laws(&self.parts, &self.at().setup.model, &self.at().parameters)
    }

    fn at(&self) -> &Stochastic {
        &self.fitted.at
    }

    /// What is known before the data of each that is free: logarithm of the density, precision.
    fn priors(&self) -> Vec<(f64, f64)> {
        let at = self.at();
        let (own, laws) = at.setup.free.split_at(self.own(0).start);
        let own = own.iter().map(|f| {
            let value = at.parameters[f.index];
            (-0.5 * f.prior.at(value).0.powi(2), f.prior.precision(value))
        });
        let laws = laws.iter().zip(self.known.iter().flatten()).map(|(f, known)| {
            let value = at.parameters[f.index];
            let even = |size: f64| (-size.ln(), 12.0 / (size * size));
            match known {
                Known::Strength(width) => {
                    let square = (value / width).powi(2) + (2.0 * PI * width * width).ln();
                    (-0.5 * square, 1.0 / (width * width))
                }
                Known::Inner(range) => even((value.abs() * range).max(1e-300)),
                Known::Angle => even(2.0 * PI),
            }
        });
        let mut priors: Vec<(f64, f64)> = own.chain(laws).collect();
        priors.resize(self.fitted.pass.gradient.len(), (0.0, 12.0 / (RANGE.0 + RANGE.1).powi(2)));
        priors
    }

    /// ln ∫ exp(ln L/c + ln π) of the parameters that are `kept`, the others where they are and without their priors.
    fn integral(&self, c: f64, kept: impl Fn(usize) -> bool) -> f64 {
        let priors = self.priors();
        let Pass { log, information, .. } = &self.fitted.pass;
        let kept: Vec<usize> = (0..priors.len()).filter(|a| kept(*a)).collect();
        let (all, n) = (priors.len(), kept.len());
        let mut h = vec![0.0; n * n];
        for (i, a) in kept.iter().enumerate() {
            for (j, b) in kept.iter().enumerate() {
                h[i * n + j] = information[a * all + b] / c;
            }
            h[i * n + i] += priors[*a].1;
        }
        let prior: f64 = kept.iter().map(|a| priors[*a].0).sum();
        log / c + prior + 0.5 * n as f64 * (2.0 * PI).ln() - 0.5 * qr::log_determinant(&h, n)
    }

    /// ln Z with the likelihood tempered by `c`, among `candidates` laws.
    fn evidence(&self, c: f64, candidates: usize) -> f64 {
        self.integral(c, |_| true) - self.parts.len() as f64 * (candidates.max(1) as f64).ln()
    }

    /// The free parameters of a law; those of the machine are before them.
    fn own(&self, law: usize) -> Range<usize> {
        let first = self.at().setup.free.len() - self.known[law..].iter().map(Vec::len).sum::<usize>();
        first..first + self.known.get(law).map_or(0, Vec::len)
    }
}

/// Another law in the place of one of the chosen.
#[derive(Debug, Clone)]
pub(crate) struct Other {
    /// The law as it would stand in the model.
    pub(crate) part: MechanismTerm,
    /// Its probability.
    pub(crate) probability: f64,
    /// The data cannot separate the two.
    pub(crate) equivalent: bool,
}

/// A law of the chosen hypothesis.
#[derive(Debug, Clone)]
pub(crate) struct Belief {
    /// Its probability, all others given.
    pub(crate) probability: f64,
    /// Probability of its family and of what the data cannot separate from it, all others given.
    pub(crate) family: f64,
    /// ln of its evidence over that of the hypothesis without it.
    pub(crate) gain: f64,
    /// What could stand in its place.
    pub(crate) others: Vec<Other>,
    /// The data hold its name: its place was offered to all candidates, and neither they nor forces of free shape are as
    /// likely there.
    pub(crate) named: bool,
}

/// What the exploration believes.
#[derive(Debug, Clone)]
pub(crate) struct Posterior {
    /// The machine's equations with the laws whose families are all named.
    pub(crate) chosen: Hypothesis,
    /// Per law of it.
    pub(crate) beliefs: Vec<Belief>,
    /// Where no law is named: the likeliest hypothesis that has some.
    pub(crate) tried: Option<Hypothesis>,
    /// The work ran out before the exploration had come to its end.
    pub(crate) limited: bool,
}

/// The exploration with everything it needs.
pub(crate) struct Explorer<'a, 'b> {
    search: &'a Search<'b>,
    machine: Setup,
    filter: Filter,
    /// Work after which it looks for nothing more.
    most_work: u64,
    /// What is known of the parameters of each candidate before the data.
    priors: Vec<Vec<Known>>,
    /// All hypotheses that were fitted.
    rows: Vec<Hypothesis>,
    /// Which of them have their extensions among the others.
    extended: Vec<bool>,
    /// How much the likelihood overstates what the samples tell.
    inflation: f64,
}

impl<'a, 'b> Explorer<'a, 'b> {
    /// Of a machine with its inputs held as a search decided.
    pub(crate) fn new(search: &'a Search<'b>, machine: &Setup) -> Explorer<'a, 'b> {
        // With a limit of work of its own.
        let most_work = search.most_work / SHARE_OF_WORK;
        let work = Arc::new(Work::of_fits_within(most_work));
        search.listener.begins(&work);
        let machine = Setup { noise: None, work, ..machine.clone() };
        let filter = Filter::new(&machine);
        Explorer {
            search,
            machine,
            filter,
            most_work,
            priors: Vec::new(),
            rows: Vec::new(),
            extended: Vec::new(),
            inflation: 1.0,
        }
    }

    fn listener(&self) -> &dyn ProgressListener {
        self.search.listener
    }

    fn evidence(&self, h: &Hypothesis) -> f64 {
        h.evidence(self.inflation, self.search.candidates().len())
    }

    /// The machine's equations alone, from parameters that another fit found or from those that are stated.
    fn machine_alone(&self, found: &[f64]) -> Option<Hypothesis> {
        let stated = self.machine.values();
        let start = |parameters: &[f64]| Stochastic {
            setup: self.machine.clone(),
            parameters: parameters.to_vec(),
            errors: self.filter.first_errors(),
            starts: Vec::new(),
        };
        let fits: Vec<Option<Filtered>> = [found, &stated]
            .par_iter()
            .map(|parameters| self.filter.fit(start(parameters), self.weight(), CALIBRATION))
            .collect();
        let fitted = fits.into_iter().flatten().max_by(|a, b| a.objective.total_cmp(&b.objective))?;
        Some(Hypothesis { parts: Vec::new(), known: Vec::new(), fitted })
    }

    /// Weight of the likelihood in a fit.
    fn weight(&self) -> f64 {
        1.0 / self.inflation.max(self.filter.strides().len() as f64)
    }

    /// The same hypothesis where the machine's parameters are as stated, if some are far from it.
    fn as_stated(&self, h: &Hypothesis) -> Option<Hypothesis> {
        let at = h.at();
        let far =
            self.machine.free.iter().any(|f| f.prior.at(at.parameters[f.index]).0.abs() > FAR_FROM_STATED);
        if !far || !h.parts.is_empty() {
            return None;
        }
        let held = Setup { free: Vec::new(), ..self.machine.clone() };
        let start = Stochastic { setup: held, parameters: self.machine.values(), ..at.clone() };
        let mut fitted = self.filter.fit(start, self.weight(), LAST_STEPS)?;
        fitted.at.setup.free.clone_from(&self.machine.free);
        Some(Hypothesis { parts: Vec::new(), known: Vec::new(), fitted })
    }

    /// Segments over all data, with the starts that a hypothesis gives them.
    fn level(&self, h: &Hypothesis) -> (Segmentation, Point) {
        let at = h.at();
        let level = at.setup.level(SEGMENTS);
        let starts = at.setup.starts(&level, &at.parameters);
        (level, Point { parameters: at.parameters.clone(), starts })
    }

    /// The score test of all open candidates in the innovations of a hypothesis, best first.
    fn proposals(&self, h: &Hypothesis, open: &[Candidate]) -> Vec<Scored> {
        let library = self.search.library;
        let at = h.at();
        let setup = &at.setup;
        let (level, point) = self.level(h);
        let scale = at.errors.noise();
        let (along, forces) =
            TrajectoryEval::observed(FitPoint { setup, level: &level, scale: &scale, point: &point });
        let spectra =
            Spectra::new(FitPoint { setup, level: &level, scale: &scale, point: &point }, &along, &forces);
        let lanes = lanes(setup, library, open, &along, &spectra, &Cover::default());
        let blocks: Vec<_> = lanes.variants.iter().map(|v| v.columns.clone()).collect();
        let gram = innovations(&self.filter, at, &lanes.signals, &[], &lanes.columns, &blocks);
        let Some(mut gram) = gram else { return Vec::new() };
        gram.add_priors(&setup.free, &at.parameters, self.weight());
        let promised = |s: &Scored| 0.5 * s.gain * gram.remaining() * self.weight();
        scored(library, open, &lanes, &gram).into_iter().filter(|s| promised(s) > PROMISING).collect()
    }

    /// What is known of the parameters of all candidates before the data.
    fn all_priors(&self, machine: &Hypothesis) -> Vec<Vec<Known>> {
        let candidates = self.search.candidates();
        let setup = &machine.at().setup;
        let (level, point) = self.level(machine);
        let scale = &setup.data.spread;
        let (along, forces) =
            TrajectoryEval::observed(FitPoint { setup, level: &level, scale, point: &point });
        let spectra = Spectra::new(FitPoint { setup, level: &level, scale, point: &point }, &along, &forces);
        let lanes = lanes(setup, self.search.library, candidates, &along, &spectra, &Cover::default());
        let total = totals(setup, &along);
        (0..candidates.len()).map(|c| self.prior_of(c, &lanes, &total)).collect()
    }

    fn prior_of(&self, index: usize, lanes: &CandidateResponses, total: &Totals) -> Vec<Known> {
        let mechanism = &self.search.library[self.search.candidates()[index].mechanism];
        let variants = || lanes.variants.iter().filter(|v| v.candidate == index);
        // Of a strength: the widest of what any choice of the inner parameters says.
        let width = |i: usize| {
            variants()
                .filter(|v| v.finite_difference.is_none())
                .filter_map(|v| v.columns.clone().nth(i))
                .map(|column| total.width(lanes, column))
                .filter(|w| w.is_finite() && *w > 0.0)
                .fold(0.0, f64::max)
        };
        let widest = (0..mechanism.linear.len()).map(width).fold(0.0, f64::max);
        let or_one = |w: f64| if w > 0.0 { w } else { 1.0 };
        mechanism
            .parameters()
            .map(|name| {
                if let Some((_, inner)) = mechanism.inner(name) {
                    return Known::Inner((inner.high / inner.low.max(LEAST * inner.high)).ln().max(1.0));
                }
                match mechanism.linear.iter().position(|l| l == name) {
                    Some(i) => Known::Strength(or_one(width(i))),
                    None => match mechanism.first.iter().find(|f| f.0 == name) {
                        Some((_, First::Angle(..))) => Known::Angle,
                        _ => Known::Strength(or_one(widest)),
                    },
                }
            })
            .collect()
    }

    /// What another search found, as a hypothesis.
    fn adopted(&self, machine: &Hypothesis, other: &FittedModel) -> Option<Hypothesis> {
        if other.parts.is_empty() {
            return None;
        }
        let n0 = self.machine.model.parameters.len();
        let point = &other.fit.point;
        let mut fresh = vec![Vec::new(); self.machine.data.pieces.len()];
        for (segment, start) in
            other.level.segments.iter().zip(&point.starts).filter(|s| s.0.range.start == 0)
        {
            for (j, state) in other.setup.model.states.iter().enumerate() {
                if self.machine.model.state(&state.name).is_none() {
                    let at = other.setup.system.offsets[j];
                    fresh[segment.piece].extend_from_slice(&start[at..at + state.order]);
                }
            }
        }
        let laws = self.search.laws(other);
        let mut draft = self.assembled(machine, &laws, &point.parameters[..n0], &fresh)?;
        draft.start.setup.method = other.setup.method;
        self.fit(draft, LAST_STEPS)
    }

    fn fit(&self, draft: Draft, steps: usize) -> Option<Hypothesis> {
        let Draft { parts, known, start } = draft;
        let fitted = self.filter.fit(start, self.weight(), steps)?;
        Some(Hypothesis { parts, known, fitted })
    }

    /// A hypothesis with these laws and the parameters of the machine; new states start as `fresh` says, per piece.
    fn assembled(
        &self,
        base: &Hypothesis,
        laws: &[Law],
        machine: &[f64],
        fresh: &[Vec<f64>],
    ) -> Option<Draft> {
        let at = base.at();
        let prior = |law: &Law| {
            let index = self.search.candidates().iter().position(|c| *c == law.0)?;
            self.priors.get(index).cloned()
        };
        let known = laws.iter().map(prior).collect::<Option<Vec<_>>>()?;
        let (mut setup, parts) = self.search.assemble(&self.machine.holds, machine, laws, &at.setup).ok()?;
        setup.noise = None;
        let first = self.machine.free.len();
        for (f, known) in setup.free[first..].iter_mut().zip(known.iter().flatten()) {
            if let Known::Strength(width) = known {
                f.prior = Prior::Normal { mean: 0.0, std: *width };
            }
        }
        fn of(starts: &[Vec<f64>], piece: usize) -> &[f64] {
            starts.get(piece).map_or(&[], Vec::as_slice)
        }
        let start = |p| carried(&at.setup, of(&at.starts, p), &setup, of(fresh, p), f64::NAN);
        let starts = (0..setup.data.pieces.len()).map(start).collect();
        let (parameters, errors) = (setup.values(), at.errors.clone());
        Some(Draft { parts, known, start: Stochastic { setup, parameters, errors, starts } })
    }

    /// A hypothesis with one law more, where the likeliest of several starts is.
    fn extended_by(&self, h: &Hypothesis, candidate: &Candidate, s: &Scored) -> Option<Draft> {
        let n0 = self.machine.model.parameters.len();
        let at = h.at();
        let mechanism = &self.search.library[candidate.mechanism];
        let fresh = if mechanism.states.is_empty() {
            Vec::new()
        } else {
            let (level, point) = self.level(h);
            let noise = at.errors.noise();
            let fitted = FitPoint { setup: &at.setup, level: &level, scale: &noise, point: &point };
            let along = TrajectoryEval::smoothed(fitted);
            first_states(&at.setup, mechanism, candidate, &along)?
        };
        let mut laws = h.laws();
        laws.push((candidate.clone(), s.values.clone(), s.scales.clone()));
        let mut draft = self.assembled(h, &laws, &at.parameters[..n0], &fresh)?;
        let start = &mut draft.start;
        if !mechanism.states.is_empty() {
            // What it brings along may be faster than the machine.
            let tolerance: Vec<f64> = start.setup.data.spread.iter().map(|s| 1e-3 * s).collect();
            start.setup.choose_method(&tolerance, usize::MAX);
        }
        let own = start.parameters.len() - s.values.len();
        let point = |values: &[f64], shift: Option<&[f64]>| {
            let mut parameters = start.parameters.clone();
            parameters[own..].copy_from_slice(values);
            for (f, d) in at.setup.free.iter().zip(shift.into_iter().flatten()) {
                parameters[f.index] = (parameters[f.index] + d).max(f.lower).min(f.upper);
            }
            parameters
        };
        let mut points = vec![point(&s.values, None), point(&s.values, Some(&s.shift))];
        points.extend(s.reduced_start.iter().map(|reduced_start| point(reduced_start, None)));
        points.extend(s.others.iter().map(|(_, values, shift)| point(values, Some(shift))));
        let mut best = f64::NEG_INFINITY;
        let mut likeliest = None;
        for parameters in points {
            let trial = Stochastic { parameters, ..start.clone() };
            let log = self.filter.glance(&trial).filter(|log| *log >= best);
            if let Some(log) = log {
                (best, likeliest) = (log, Some(trial));
            }
        }
        *start = likeliest?;
        Some(draft)
    }

    /// The hypothesis with one law more, for the first `most` of those that promise something, fitted by so many steps.
    fn trials(&self, h: &Hypothesis, open: &[Candidate], most: usize, steps: usize) -> Vec<Hypothesis> {
        let scored = self.proposals(h, open);
        let mut short = self.search.short_list(open, &scored, 0.0, SHORT_LIST, 0);
        short.truncate(most);
        self.listener().stage(Stage::Fitting { candidates: short.len() });
        let trial = |s: &&Scored| self.fit(self.extended_by(h, &open[s.candidate], s)?, steps);
        short.par_iter().filter_map(trial).collect()
    }

    /// Some hypotheses after further steps, as far as they are admissible.
    fn refined(&self, trials: Vec<Hypothesis>, steps: usize) -> Vec<Hypothesis> {
        let go_on = |h: Hypothesis| {
            let fitted = self.filter.fit(h.fitted.at, self.weight(), steps)?;
            Some(Hypothesis { fitted, ..h })
        };
        trials.into_par_iter().filter_map(go_on).filter(|h| self.is_admissible(h)).collect()
    }

    /// The likeliest of some hypotheses, and the others, likeliest first.
    fn likeliest(&self, trials: Vec<Hypothesis>, most: usize) -> (Vec<Hypothesis>, Vec<Hypothesis>) {
        let mut ranked: Vec<(f64, Hypothesis)> = trials.into_iter().map(|h| (self.evidence(&h), h)).collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut first: Vec<Hypothesis> = ranked.into_iter().map(|r| r.1).collect();
        let others = first.split_off(first.len().min(most));
        (first, others)
    }

    /// The hypothesis with one law more, for each that promises something, fitted; some of them twice.
    fn extensions(&self, base: &Hypothesis) -> Vec<Hypothesis> {
        let library = self.search.library;
        let taken = |c: &Candidate| {
            base.candidates().any(|own| {
                let (refines, kind) = (&library[own.mechanism].refines, &library[c.mechanism].kind);
                own == c
                    || own.place == c.place
                        && (refines.contains(kind)
                            || library[c.mechanism].refines.contains(&library[own.mechanism].kind))
            })
        };
        // (What a single recording shows at certain times may not come back: it is never handed back beside an error.)
        let all = self.search.candidates().iter();
        let open: Vec<Candidate> =
            all.filter(|c| !taken(c) && !self.search.is_bound_to_a_clock(c)).cloned().collect();
        self.listener().stage(Stage::Screening { candidates: open.len(), found: base.parts.len() });
        let trials = self.trials(base, &open, SHORT_LIST, FIRST_STEPS);
        let (trials, _) = self.likeliest(trials, FINALISTS);
        let (best, others) = self.likeliest(self.refined(trials, MORE_STEPS), BEST);
        let mut out = self.refined(best, LAST_STEPS);
        out.extend(others);
        if let Some(stated) = self.as_stated(base) {
            // (What starts at stated parameters has far to go: a few steps tell nothing.)
            let trials = self.trials(&stated, &open, FINALISTS, 0);
            out.extend(self.refined(trials, LAST_STEPS));
        }
        out
    }

    /// Whether every law's requirements hold, and no inertia is negative.
    fn is_admissible(&self, h: &Hypothesis) -> bool {
        let at = h.at();
        let (level, point) = self.level(h);
        let scale = vec![1.0; at.errors.sensor.len()];
        self.search.is_admissible(
            &h.parts,
            FitPoint { setup: &at.setup, level: &level, scale: &scale, point: &point },
        )
    }

    /// The hypothesis without one of its laws, fitted.
    fn without(&self, h: &Hypothesis, index: usize) -> Option<Hypothesis> {
        let mut laws = h.laws();
        laws.remove(index);
        let others: Vec<&Candidate> = laws.iter().map(|law| &law.0).collect();
        if let Some(known) = self.rows.iter().find(|row| row.is(&others)) {
            return Some(known.clone());
        }
        let n0 = self.machine.model.parameters.len();
        self.fit(self.assembled(h, &laws, &h.at().parameters[..n0], &[])?, LAST_STEPS)
    }

    /// Keeps a hypothesis, or the better of two fits of it; its index.
    fn keep(&mut self, h: Hypothesis) -> usize {
        let candidates: Vec<&Candidate> = h.candidates().collect();
        match self.rows.iter().position(|row| row.is(&candidates)) {
            Some(i) => {
                if self.evidence(&h) > self.evidence(&self.rows[i]) {
                    self.rows[i] = h;
                }
                i
            }
            None => {
                self.rows.push(h);
                self.extended.push(false);
                self.rows.len() - 1
            }
        }
    }

    /// Keeps the extensions of a row.
    fn extend(&mut self, row: usize) {
        if !std::mem::replace(&mut self.extended[row], true) {
            for h in self.extensions(&self.rows[row]) {
                self.keep(h);
            }
        }
    }

    /// Row of the highest evidence among some.
    fn best(&self, of: impl Fn(&Hypothesis) -> bool) -> Option<usize> {
        let rows = self.rows.iter().enumerate().filter(|(_, h)| of(h));
        rows.map(|(i, h)| (i, self.evidence(h))).max_by(|a, b| a.1.total_cmp(&b.1)).map(|b| b.0)
    }

    /// Takes the inflation of a row over.
    fn temper(&mut self, row: usize) {
        let h = &self.rows[row];
        let horizons = self.filter.strides().len() as f64;
        self.inflation = h.fitted.pass.inflation(h.at().setup.free.len()).max(horizons);
    }

    /// Whether the work is used up, or nobody waits for the answer any more.
    fn is_spent(&self) -> bool {
        let work = &self.machine.work;
        work.is_given_up() || work.done() > self.most_work
    }

    /// Explores from parameters of the machine that another search found, and what it found beside them; `None` where the
    /// filter cannot follow the machine.
    pub(crate) fn explore(mut self, found: &[f64], others: &[&FittedModel]) -> Option<Posterior> {
        self.listener().stage(Stage::Calibrating);
        self.inflation = self.filter.strides().len() as f64;
        let machine = self.machine_alone(found)?;
        self.priors = self.all_priors(&machine);
        self.keep(machine);
        self.temper(0);
        for other in others {
            if let Some(h) = self.adopted(&self.rows[0], other)
                && self.is_admissible(&h)
            {
                self.keep(h);
            }
        }
        let mut beam = vec![0];
        for laws in 1..=MOST {
            if self.is_spent() {
                break;
            }
            let before = self.best(|h| h.parts.len() < laws).map(|i| self.evidence(&self.rows[i]))?;
            beam.iter().for_each(|row| self.extend(*row));
            let mut next: Vec<usize> =
                (0..self.rows.len()).filter(|i| self.rows[*i].parts.len() == laws).collect();
            next.sort_by(|a, b| self.evidence(&self.rows[*b]).total_cmp(&self.evidence(&self.rows[*a])));
            next.truncate(BEAM);
            let Some(&first) = next.first() else { break };
            let after = self.evidence(&self.rows[first]);
            // Of one law alone: two may only help together.
            if after <= before && laws > 1 {
                break;
            }
            if after > before {
                self.temper(first);
            }
            beam = next;
        }
        let mut best = self.best(|_| true)?;
        for _ in 0..ROUNDS {
            if self.is_spent() || self.rows[best].parts.is_empty() {
                break;
            }
            let laws = self.rows[best].parts.len();
            for index in 0..laws {
                if let Some(base) = self.without(&self.rows[best], index) {
                    let row = self.keep(base);
                    self.extend(row);
                }
            }
            let now = self.best(|_| true)?;
            if now == best {
                break;
            }
            best = now;
        }
        self.conclude(best)
    }

    /// Lets laws go whose families are not named, from the best row on.
    fn conclude(&mut self, best: usize) -> Option<Posterior> {
        self.temper(best);
        let mut chosen = best;
        loop {
            let mut beliefs = self.beliefs(chosen);
            let weakest = (0..beliefs.len()).min_by(|a, b| beliefs[*a].family.total_cmp(&beliefs[*b].family));
            match weakest {
                Some(index) if beliefs[index].family < NAMED => {
                    let smaller = self.without(&self.rows[chosen], index)?;
                    chosen = self.keep(smaller);
                }
                _ => {
                    self.name(chosen, &mut beliefs);
                    let some = self.best(|h| !h.parts.is_empty());
                    let tried = if beliefs.is_empty() { some.map(|i| self.rows[i].clone()) } else { None };
                    let limited = self.is_spent();
                    return Some(Posterior { chosen: self.rows[chosen].clone(), beliefs, tried, limited });
                }
            }
        }
    }

    /// Tells of which laws of a row the data hold the name, were something else allowed: a force of free shape beside them, or
    /// in the place of some.
    fn name(&self, row: usize, beliefs: &mut [Belief]) {
        if beliefs.is_empty() {
            return;
        }
        let h = &self.rows[row];
        let candidates = self.search.candidates().len();
        let (library, level) = (self.search.library, self.level(h));
        let beside = Beside::of(h, &self.filter, library, &level, self.inflation, candidates);
        let Some(beside) = beside else { return };
        // Laws that a shape replaces, by bits; and the odds of that against all laws, a shape beside them or none.
        let evidence = |replaced: usize| {
            let laws: Vec<usize> = (0..h.parts.len()).filter(|i| replaced >> i & 1 == 1).collect();
            beside.evidence(&laws).unwrap_or(f64::NEG_INFINITY)
        };
        let with_all = log_sum(&[0.0, evidence(0)]);
        let odds: Vec<f64> = (1..1 << h.parts.len())
            .map(|set| (evidence(set) - with_all).clamp(-700.0, 700.0).exp())
            .collect();
        for (i, belief) in beliefs.iter_mut().enumerate() {
            let something_else: f64 = odds
                .iter()
                .enumerate()
                .filter(|(set, _)| (set + 1) >> i & 1 == 1)
                .map(|(_, odds)| odds)
                .sum();
            // Of its kin, and of all that was tried in its place.
            let (kin, total) = (belief.family / belief.probability, 1.0 / belief.probability);
            let mut rest: Vec<&Candidate> = h.candidates().collect();
            rest.remove(i);
            let mut extended = self.rows.iter().zip(&self.extended).filter(|row| *row.1);
            belief.named = kin / (total + something_else) >= NAMED && extended.any(|row| row.0.is(&rest));
        }
    }

    /// What is believed of each law of a row, all others given.
    fn beliefs(&self, row: usize) -> Vec<Belief> {
        let h = &self.rows[row];
        let own = self.evidence(h);
        let library = self.search.library;
        let family = |c: &Candidate| &library[c.mechanism].family;
        (0..h.parts.len())
            .map(|index| {
                let mut rest: Vec<&Candidate> = h.candidates().collect();
                let candidate = rest.remove(index);
                let (mut total, mut kin) = (1.0, 1.0);
                let mut gain = f64::INFINITY;
                let mut others = Vec::new();
                for other in self.rows.iter().filter(|o| rest.iter().all(|c| o.holds(c))) {
                    let odds = (self.evidence(other) - own).clamp(-700.0, 700.0).exp();
                    if other.parts.len() == rest.len() {
                        gain = own - self.evidence(other);
                        total += odds;
                    } else if other.parts.len() == h.parts.len() {
                        let Some(at) = other.candidates().position(|c| !rest.contains(&c)) else { continue };
                        let its = &other.parts[at].candidate;
                        if its == candidate {
                            continue;
                        }
                        total += odds;
                        if family(its) == family(candidate) || is_equal(odds) {
                            kin += odds;
                        }
                        others.push((other.parts[at].clone(), odds));
                    }
                }
                let mut others: Vec<Other> = others
                    .into_iter()
                    .map(|(part, odds)| Other { part, probability: odds / total, equivalent: is_equal(odds) })
                    .collect();
                others.sort_by(|a, b| b.probability.total_cmp(&a.probability));
                Belief { probability: 1.0 / total, family: kin / total, gain, others, named: false }
            })
            .collect()
    }
}

/// The inner products of the innovations of a model, their sensitivities, and what signals do to them: some columns of lanes
/// beside the parameters, and some of which these blocks are wanted.
fn innovations(
    filter: &Filter,
    at: &Stochastic,
    signals: &[Arc<SignalLanes>],
    beside: &[Range<usize>],
    columns: &[Range<usize>],
    blocks: &[Range<usize>],
) -> Option<Gram> {
    let np = at.setup.free.len() + beside.len();
    let new = || (Gram::new(np, columns.len(), blocks), Vec::new());
    let parts = filter.run(at, true, Some(signals), new, |(gram, row), i| {
        let root = i.s.sqrt();
        row.clear();
        row.extend(i.by_parameters.iter().map(|de| -de / root));
        let lanes = beside.iter().chain(columns);
        row.extend(lanes.map(|lanes| -i.by_signals[lanes.clone()].iter().sum::<f64>() / root));
        gram.add_row(i.e / root, &row[..np], &row[np..]);
    })?;
    let mut gram = Gram::new(np, columns.len(), blocks);
    parts.iter().for_each(|part| gram.add(&part.0));
    Some(gram)
}

/// Whether no one would bet on one of two.
fn is_equal(odds: f64) -> bool {
    odds.ln().abs() < UNDECIDED
}

/// Sizes of what acts on a machine.
struct Totals {
    /// Per equation: RMS of its force.
    forces: Vec<f64>,
    /// Per input and per channel: spread.
    inputs: Vec<f64>,
    outputs: Vec<f64>,
}

impl Totals {
    /// The strength at which a column is as large as all that acts where it does.
    fn width(&self, lanes: &CandidateResponses, column: usize) -> f64 {
        let Some(first) = lanes.signals.first() else { return f64::INFINITY };
        // Of one lane in a table of each piece.
        let rms = |of: &dyn Fn(&SignalLanes) -> Option<&Vec<f64>>, lane: usize| -> f64 {
            let (mut sum, mut n) = (0.0, 0usize);
            let tables = lanes.signals.iter().filter_map(|s| of(s));
            for v in tables.flat_map(|table| table.iter().skip(lane).step_by(first.lanes.max(1))) {
                sum += v * v;
                n += 1;
            }
            (sum / n.max(1) as f64).sqrt()
        };
        fn table(tables: &[(usize, Vec<f64>)], index: usize) -> Option<&Vec<f64>> {
            tables.iter().find(|t| t.0 == index).map(|t| &t.1)
        }
        let mut width = f64::INFINITY;
        let mut narrow = |total: f64, size: f64| {
            if size > 0.0 {
                width = width.min(total / size);
            }
        };
        for lane in lanes.columns[column].clone() {
            let force = rms(&|s| Some(&s.force), lane);
            for (e, total) in self.forces.iter().enumerate() {
                narrow(*total, force * first.weights.get(e * first.lanes + lane).map_or(0.0, |w| w.abs()));
            }
            for (i, total) in self.inputs.iter().enumerate() {
                narrow(*total, rms(&|s| table(&s.inputs, i), lane));
            }
            for (c, total) in self.outputs.iter().enumerate() {
                narrow(*total, rms(&|s| table(&s.outputs, c), lane));
            }
        }
        width
    }
}

/// How large all is that acts on a machine.
fn totals(setup: &Setup, along: &TrajectoryEval<'_>) -> Totals {
    let spread = |series: &mut dyn Iterator<Item = &Vec<f64>>| -> f64 {
        series.map(|v| greybox_calibrate::spread(v)).fold(0.0, f64::max)
    };
    let data = &setup.data;
    Totals {
        forces: along.total_forces(),
        inputs: (0..setup.model.inputs.len())
            .map(|i| spread(&mut data.pieces.iter().filter_map(|p| p.inputs.get(i))))
            .collect(),
        outputs: data.spread.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::{Mechanism, built_in};
    use greybox_calibrate::{Data, free_parameters};
    use greybox_model::Model;
    use greybox_recording::{Channel, Recording};
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    const MASS: &str = r#"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.0, unit = "kg", fixed = true }
k = { value = 20.0, unit = "N/m" }
[equations]
mass = "m*x'' + k*x = f"
"#;

    /// A mass on a spring of 22 N/m with a damper, driven by two sines, pushed by a slow random force (0.3 s) of this size, and
    /// measured to a tenth of a millimetre.
    fn mass(damping: f64, push: f64, seed: u64) -> Setup {
        mass_with(&|v| damping * v, push, seed)
    }

    /// The same with any friction of its speed.
    fn mass_with(friction: &dyn Fn(f64) -> f64, push: f64, seed: u64) -> Setup {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let (dt, n, fine) = (0.02, 1500usize, 10usize);
        let drive = |t: f64| 2.0 * (2.1 * t).sin() + 1.5 * (5.3 * t).cos();
        let (mut x, mut v, mut w) = (0.0, 0.0, 0.0);
        let (mut xs, mut fs, mut time) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..n {
            let t = dt * k as f64;
            time.push(t);
            fs.push(drive(t));
            xs.push(x + 1e-4 * normal());
            let h = dt / fine as f64;
            let decay = (-h / 0.3f64).exp();
            for i in 0..fine {
                w = decay * w + push * (1.0 - decay * decay).sqrt() * normal();
                let a = drive(t + (i as f64 + 0.5) * h) + w - 22.0 * x - friction(v);
                v += h * a;
                x += h * v;
            }
        }
        let channel = |name: &str, values: Vec<f64>| Channel { name: name.into(), unit: None, values };
        let channels = vec![channel("f", fs), channel("x", xs)];
        let recording = Recording::from_columns("mass.csv", time, channels).unwrap();
        let model = Model::from_toml(MASS, "mass.toml").unwrap();
        let data = Arc::new(Data::new(&model, &[recording]).unwrap());
        Setup::new(&model, data, free_parameters(&model)).unwrap()
    }

    fn some_laws() -> Vec<Mechanism> {
        let kinds =
            ["viscous_friction", "coulomb_friction", "cubic_stiffness", "constant_offset", "input_delay"];
        built_in().unwrap().into_iter().filter(|m| kinds.contains(&m.kind.as_str())).collect()
    }

    /// What is believed, the library's kinds in the order of the hypothesis, and whether the data hold the name.
    fn believed(setup: &Setup, library: &[Mechanism]) -> Vec<(String, bool)> {
        let search = Search::new(setup.clone(), library, &crate::Quiet);
        let posterior = Explorer::new(&search, setup).explore(&setup.values(), &[]).unwrap();
        assert!(!posterior.limited);
        let kind = |p: &MechanismTerm| library[p.candidate.mechanism].kind.clone();
        posterior.chosen.parts.iter().map(kind).zip(posterior.beliefs.iter().map(|b| b.named)).collect()
    }

    /// An exploration that knows its priors, and the machine alone.
    fn begun<'a, 'b>(search: &'a Search<'b>, setup: &Setup) -> (Explorer<'a, 'b>, Hypothesis) {
        let mut explorer = Explorer::new(search, setup);
        let machine = explorer.machine_alone(&setup.values()).unwrap();
        explorer.priors = explorer.all_priors(&machine);
        (explorer, machine)
    }

    /// A damper of a fifth of the critical damping among pushes half as large as the drive is named, and alone; without
    /// it nothing is.
    #[test]
    fn a_damper_is_named_among_random_forces_and_nothing_is_where_there_is_none() {
        let library = some_laws();
        let seeds = 6u64;
        let damper = [("viscous_friction".to_string(), true)];
        let right = (0..seeds).filter(|seed| believed(&mass(1.9, 1.0, 40 + seed), &library) == damper);
        let right = right.count() as u64;
        let wrong =
            (0..seeds).filter(|seed| !believed(&mass(0.0, 1.0, 80 + seed), &library).is_empty()).count();
        assert!(right >= seeds - 1, "{right} of {seeds}");
        assert_eq!(wrong, 0);
    }

    /// A drag with the cube of the speed, in a library without one: what stands in for it is believed to act, and is not
    /// named.
    #[test]
    fn what_stands_in_for_another_law_is_not_named() {
        let library = some_laws();
        for seed in 0..4 {
            let setup = mass_with(&|v| 1.2 * v * v.abs() * v.abs(), 0.2, 140 + seed);
            let believed = believed(&setup, &library);
            assert!(!believed.is_empty(), "seed {seed}");
            assert!(believed.iter().all(|law| !law.1), "seed {seed}: {believed:?}");
        }
    }

    /// The work may run out before a law has had its alternatives.
    #[test]
    fn a_law_is_named_only_where_its_place_was_offered_to_all() {
        let setup = mass(1.9, 1.0, 41);
        let library = some_laws();
        let search = Search::new(setup.clone(), &library, &crate::Quiet);
        let (mut explorer, machine) = begun(&search, &setup);
        let is_damped = |h: &Hypothesis| library[h.parts[0].candidate.mechanism].kind == "viscous_friction";
        let damped = explorer.extensions(&machine).into_iter().find(is_damped).unwrap();
        let without = explorer.keep(machine);
        let row = explorer.keep(damped);
        for offered in [false, true] {
            explorer.extended[without] = offered;
            let beliefs = explorer.conclude(row).unwrap().beliefs;
            assert_eq!(beliefs.iter().map(|b| b.named).collect::<Vec<_>>(), [offered]);
        }
    }

    /// A law costs the logarithm of how many candidates there are, and that of how wide the prior of its strength is.
    #[test]
    fn what_could_have_been_otherwise_counts_against_a_law() {
        let setup = mass(1.9, 0.1, 3);
        let library = some_laws();
        let search = Search::new(setup.clone(), &library, &crate::Quiet);
        let (explorer, machine) = begun(&search, &setup);
        let damped = explorer
            .extensions(&machine)
            .into_iter()
            .find(|h| library[h.parts[0].candidate.mechanism].kind == "viscous_friction");
        let damped = damped.unwrap();
        let fewer = damped.evidence(4.0, 10) - damped.evidence(4.0, 100);
        assert!((fewer - 10f64.ln()).abs() < 1e-9);
        let Known::Strength(width) = damped.known[0][0] else { panic!("a damper has a strength") };
        let with = |width: f64| {
            let known = vec![vec![Known::Strength(width)]];
            Hypothesis { known, ..damped.clone() }.evidence(4.0, 10)
        };
        let wider = with(10.0 * width) - with(100.0 * width);
        assert!((wider - 10f64.ln()).abs() < 0.01, "{wider}");
        // Half as wide a peak of the likelihood in each direction holds so much less of what was possible.
        let mut sharp = damped.clone();
        sharp.fitted.pass.information.iter_mut().for_each(|i| *i *= 4.0);
        let sharper = damped.evidence(4.0, 10) - sharp.evidence(4.0, 10);
        let all = damped.fitted.pass.gradient.len() as f64 * 2f64.ln();
        assert!(sharper > 0.9 * all && sharper < all, "{sharper} {all}");
    }

    /// The prior of a strength is as wide as the strength whose force is all that the equation balances.
    #[test]
    fn a_strength_is_expected_to_be_as_large_as_the_forces() {
        let setup = mass(1.9, 0.1, 3);
        let library = some_laws();
        let search = Search::new(setup.clone(), &library, &crate::Quiet);
        let (explorer, machine) = begun(&search, &setup);
        let width = |kind: &str| {
            let index = search.candidates().iter().position(|c| library[c.mechanism].kind == kind).unwrap();
            match explorer.priors[index][0] {
                Known::Strength(width) => width,
                _ => panic!("{kind} has a strength"),
            }
        };
        let (level, point) = explorer.level(&machine);
        let along = TrajectoryEval::smoothed(FitPoint {
            setup: &machine.at().setup,
            level: &level,
            scale: &setup.data.spread,
            point: &point,
        });
        let force = along.total_forces()[0];
        assert!((width("constant_offset") / force - 1.0).abs() < 0.05);
        assert!((width("coulomb_friction") / force - 1.0).abs() < 0.05);
        let rate = &machine.at().setup.smoothed_states.states[0][1].clone().unwrap();
        let rms = (rate.iter().map(|v| v * v).sum::<f64>() / rate.len() as f64).sqrt();
        assert!((width("viscous_friction") * rms / force - 1.0).abs() < 0.1);
    }
}
