//! The verdict: what an improved model explains, what it leaves, and which names are believed.

use std::cell::LazyCell;
use std::ops::Deref;

use greybox_model::{Expr, Func, Model};
use rayon::prelude::*;

use crate::diagnosis::Verdict;
use crate::discrepancy::{Discrepancy, held_out};
use crate::evidence::{cross_validation_improvement, effective_sample_ratio};
use crate::fitted::{FittedModel, Found, MechanismTerm};
use crate::importance::{divided, rss_alone};
use crate::library::Mechanism;
use crate::place::{Motion, Place};
use crate::search::{MISFIT, Search, UNDECIDED, log_likelihood_gain, raw_rms, raw_rss};

/// Mean over standard error of the folds' gains from which free shapes are taken seriously.
const STEADY_SHAPE: f64 = 2.0;
/// Gain of free shapes over that of the mechanisms from which these are imitations: laws of the state, and
/// mechanisms with a memory or a delay (which no shape of the state should come near).
const IMITATES_LAW: f64 = 1.1;
const IMITATES_MEMORY: f64 = 0.97;
/// Share of the calibrated model's misfit up to which a mechanism counts as a small correction.
const CORRECTION: f64 = 0.02;
/// Forces on one motion that make a patchwork (and mechanisms in one equation that cast doubt on each other).
const PATCHES: usize = 3;
/// What two laws explain together over the sum of what each adds to the other, from which they do one work.
const REDUNDANT: f64 = 4.0;
/// Mean over standard error of the folds' gains from which free shapes cast doubt on what was found, and from
/// which what they predict of innovations is called missing; and their held-out gain in log-likelihood (twice):
/// by chance fourteen columns lose fourteen, give or take five.
const STEADY_DOUBT: f64 = 1.5;
const STEADY_INNOVATIONS: f64 = 2.5;
const LIKELIER: f64 = 20.0;
/// Share of the calibrated model's misfit that laws must explain to be the answer where every model errs.
const EXPLAINED: f64 = 0.5;
/// Residual over noise from which a residual is a misfit where samples hold so little information each that it must be
/// slow.
const SLOW_MISFIT: f64 = 1.2;
const SLOW: f64 = 0.05;

/// For each part that is named, the laws without a name that do its work, or that of all parts together, better. (Beside an
/// error of the model and in a closure, such laws were among the candidates.)
fn outdone(search: &Search<'_>, found: &Found, verdict: Verdict) -> Vec<Vec<MechanismTerm>> {
    let parts: Vec<usize> = (0..found.improved.parts.len()).collect();
    if verdict != Verdict::MissingPhysics || found.errs || found.closed {
        return vec![Vec::new(); parts.len()];
    }
    let outdoes = |parts: &[usize]| {
        let (above, law) = search.unnamed_above(&found.improved, parts, &found.scale)?;
        (above > UNDECIDED).then_some(law)
    };
    let all = if parts.len() > 1 { outdoes(&parts) } else { None };
    parts.par_iter().map(|part| outdoes(&[*part]).into_iter().chain(all.clone()).collect()).collect()
}

/// A residual sum of squares over that without any mechanism.
fn share_of(rss: f64, base: f64) -> f64 {
    (rss / base.max(1e-300)).clamp(0.0, 1.0)
}

/// What an improved model explains, and what it leaves.
pub(crate) struct Judged {
    pub(crate) verdict: Verdict,
    /// Whether each part is named, if the verdict allows.
    pub(crate) named: Vec<bool>,
    /// Share of the calibrated model's misfit that each part explains.
    pub(crate) shares: Vec<f64>,
    pub(crate) left: ResidualDiagnostics,
    pub(crate) discrepancy: Option<Discrepancy>,
    /// Residual sum of squares with each part alone, without each, with all, with none.
    pub(crate) alone: Vec<f64>,
    pub(crate) without: Vec<f64>,
    pub(crate) full: f64,
    pub(crate) base: f64,
    /// How far above each part the law is that casts doubt on it.
    pub(crate) doubts: Vec<Option<f64>>,
    /// The laws without a name that do the work of each part better.
    pub(crate) outdone: Vec<Vec<MechanismTerm>>,
}

impl Judged {
    /// A residual sum of squares over that of the calibrated model.
    pub(crate) fn share(&self, rss: f64) -> f64 {
        share_of(rss, self.base)
    }

    /// Of a model with a residual like `scale` beside a calibrated one; whether its parts are named.
    pub(crate) fn of(
        search: &Search<'_>,
        found: &Found,
        improved: &FittedModel,
        scale: &[f64],
        (calibrated, named): (&FittedModel, &dyn Fn(&MechanismTerm) -> bool),
        library: &[Mechanism],
    ) -> Judged {
        // Where nothing was found, what the search's own noise model leaves white.
        let discrepancy = if found.improved.parts.is_empty() && found.improved.setup.noise.is_some() {
            discrepancy_of(&found.improved, &found.scale)
        } else {
            discrepancy_of(improved, scale)
        };
        // Two refits, for those tests that need them.
        let comparable = LazyCell::new(|| search.comparable(found));
        let full: f64 = raw_rss(improved, &found.scale).iter().sum();
        let base = search.rss_at(calibrated, improved, &found.scale);
        let left = ResidualDiagnostics::of(improved, found, &comparable, discrepancy.as_ref(), base);
        let without: Vec<f64> = (0..improved.parts.len())
            .into_par_iter()
            .map(|i| search.rss_without(improved, &[i], calibrated, &found.scale).unwrap_or(base))
            .collect();
        let share = |rss: f64| share_of(rss, base);
        let alone = rss_alone(search, (calibrated, improved), &found.scale, &without, base);
        let lost: Vec<f64> = without.iter().map(|rss| share(rss - full)).collect();
        let gained: Vec<f64> = alone.iter().map(|rss| share(base - rss)).collect();
        let shares = divided(&lost, &gained, share(base - full));
        // Two laws that share one work lose little each when the other takes over, and all together.
        let redundant = |a: usize, b: usize| {
            let both = search.rss_without(improved, &[a.max(b), a.min(b)], calibrated, &found.scale);
            let both = both.unwrap_or(base);
            (both - full) / base.max(1e-300) > REDUNDANT * (lost[a] + lost[b])
        };
        // A law that another one, which the library has no name for, stands in for.
        let doubts: Vec<Option<f64>> = (0..improved.parts.len())
            .into_par_iter()
            .map(|i| match found.errs || found.closed {
                true => None,
                false => search.doubt(&found.improved, i, &found.scale),
            })
            .collect();
        let beaten = |i: usize| doubts[i].is_some_and(|d| d > UNDECIDED);
        let is_imitation = (0..doubts.len()).any(|i| {
            beaten(i) && (lost[i] > CORRECTION || (0..doubts.len()).any(|j| i != j && redundant(i, j)))
        });
        // Where a law of another family does its work better, not even the family of a name is known.
        let outdone = outdone(search, found, left.verdict(improved.parts.len()));
        let family = |part: &MechanismTerm| &library[part.candidate.mechanism].family;
        let is_family_known = |part: &MechanismTerm, others: &[MechanismTerm]| {
            others.iter().all(|other| family(other) == family(part))
        };
        let parts = improved.parts.iter().zip(&outdone);
        let named: Vec<bool> =
            parts.map(|(part, others)| named(part) && is_family_known(part, others)).collect();
        let by_name: f64 = shares.iter().zip(&named).filter(|s| *s.1).map(|s| s.0).sum();
        let is_series_expansion = || is_series_expansion(improved, &shares, library, left.steady, redundant);
        let verdict = match left.verdict(improved.parts.len()) {
            _ if !named.contains(&true) && !improved.parts.is_empty() => Verdict::Unexplained,
            // (The exploration has held free shapes against its laws.)
            _ if found.errs && (by_name < EXPLAINED || is_series_expansion()) => Verdict::Unexplained,
            // (Of a closure the names have been held against all other terms.)
            _ if found.errs || found.closed => Verdict::MissingPhysics,
            Verdict::MissingPhysics
                if is_imitation
                    || is_series_expansion()
                    || beaten_by_discrepancy(&comparable, &found.scale, library) =>
            {
                Verdict::Unexplained
            }
            verdict => verdict,
        };
        Judged { verdict, named, shares, left, discrepancy, alone, without, full, base, doubts, outdone }
    }
}

/// A list that describes some other law piece by piece: three or more forces on one and the same motion, or two
/// of one family beside which a constant stands (a law and the first terms of its series) or forces of free shape
/// still explain something (`remains`), each a considerable part of what is missing, or the two `redundant`: nearly
/// superfluous beside each other. (Beside a law that explains nearly everything, small corrections are what a real
/// machine has.)
fn is_series_expansion(
    improved: &FittedModel,
    shares: &[f64],
    library: &[Mechanism],
    remains: bool,
    redundant: impl Fn(usize, usize) -> bool,
) -> bool {
    // Laws of one motion: added, or in the stead of a spring's or a load's term.
    let laws: Vec<(usize, &Motion, &str, bool)> = improved
        .parts
        .iter()
        .enumerate()
        .filter_map(|(i, p)| {
            let family = &*library[p.candidate.mechanism].family;
            match &p.candidate.place {
                Place::Motion(m) => Some((i, m, family, true)),
                Place::Spring { motion, .. } | Place::Load { motion, .. } => Some((i, motion, family, false)),
                _ => None,
            }
        })
        .collect();
    let considerable = |i: usize| shares[i] > CORRECTION;
    let relatives = |a: usize, b: usize| {
        let ((i, m, family, _), (j, other, its, _)) = (&laws[a], &laws[b]);
        m.coefficients == other.coefficients
            && family == its
            && ((considerable(*i) && considerable(*j)) || redundant(*i, *j))
    };
    let patches = |motion: &Motion| {
        let here = |l: &&(usize, &Motion, &str, bool)| l.3 && l.1.coefficients == motion.coefficients;
        laws.iter().filter(here).filter(|l| considerable(l.0)).count()
    };
    // What it adds depends on nothing: a constant force, or the offset of an input.
    let model = &improved.setup.model;
    let is_constant = |part: &MechanismTerm| {
        let law = &part.instance.expression;
        let input = match &part.candidate.place {
            Place::Input(i) => Some(&*model.inputs[*i].name),
            _ => None,
        };
        let mut depends = input.is_some_and(|input| law.derivative(input, 0) != Expr::Num(1.0));
        law.walk(&mut |e| {
            depends |= matches!(e, Expr::Var { name, .. }
                if model.parameter(name).is_none() && input != Some(&**name));
        });
        !depends
    };
    let beside_constant = |motion: &Motion| {
        improved.parts.iter().enumerate().any(|(i, part)| {
            let acts = match &part.candidate.place {
                Place::Equation(e) => motion.weights[*e] != 0.0,
                Place::Input(i) => {
                    let moved = model.equations.iter().zip(&motion.weights).filter(|(_, w)| **w != 0.0);
                    moved.into_iter().any(|(e, _)| e.residual().mentions(&model.inputs[*i].name))
                }
                _ => false,
            };
            acts && considerable(i) && is_constant(part)
        })
    };
    laws.iter().any(|l| considerable(l.0) && patches(l.1) >= PATCHES)
        || (0..laws.len()).any(|b| (0..b).any(|a| relatives(a, b) && (remains || beside_constant(laws[a].1))))
}

/// Whether a law stands beside another one of the same variables on the same motion: two shapes of a
/// restoring force may well be one shape that the library lacks. Beside a small correction, the law that
/// explains nearly everything stands.
pub(crate) fn is_shared(improved: &FittedModel, shares: &[f64], index: usize) -> bool {
    let of = |part: &MechanismTerm| match &part.candidate.place {
        Place::Motion(m) => {
            let mut variables: Vec<(String, u8)> = Vec::new();
            part.instance.expression.walk(&mut |e| {
                if let Expr::Var { name, primes } = e
                    && improved.setup.model.state(name).is_some()
                {
                    variables.push((name.to_string(), *primes));
                }
            });
            variables.sort();
            variables.dedup();
            Some((m.coefficients.clone(), variables))
        }
        _ => None,
    };
    let own = of(&improved.parts[index]);
    own.is_some()
        && improved.parts.iter().enumerate().any(|(i, part)| {
            i != index && of(part) == own && (shares[i] > shares[index] || shares[i] > CORRECTION)
        })
}

/// Whether a mechanism is one of three or more in one equation, each a considerable part of what is missing: so
/// many together follow nearly anything.
pub(crate) fn is_crowded(improved: &FittedModel, shares: &[f64], index: usize, nominal: &Model) -> bool {
    let equations = |part: &MechanismTerm| part.candidate.place.equations(nominal);
    let considerable = || improved.parts.iter().zip(shares).filter(|(_, share)| **share > CORRECTION);
    shares[index] > CORRECTION
        && equations(&improved.parts[index])
            .iter()
            .any(|e| considerable().filter(|(part, _)| equations(part).contains(e)).count() >= PATCHES)
}

/// Whether forces of free shape beat the mechanisms: held out by folds, they explain clearly more of the
/// calibrated model's residual, and steadily so, or as much where the mechanisms need a memory and the shapes need
/// none. A law
/// of the library is at least as good as a free shape of its variables; an imitating law need not be.
fn beaten_by_discrepancy(
    (base, improved): &(FittedModel, FittedModel),
    scale: &[f64],
    library: &[Mechanism],
) -> bool {
    let Some(free) = discrepancy_of(base, scale).filter(|s| s.t > STEADY_SHAPE) else { return false };
    // On the same folds as the free shapes: how much blocks tell of each other depends on where they are cut.
    let Some(errors) = held_out(improved.at(scale), free.block) else {
        return false;
    };
    let named = 1.0 - errors.iter().sum::<f64>() / free.without.max(1e-300);
    let (_, t) = cross_validation_improvement(&errors, &free.errors);
    let remembers = improved.parts.iter().all(|part| {
        let mut delayed = false;
        part.instance.expression.walk(&mut |e| delayed |= matches!(e, Expr::Call(Func::Delay, _)));
        delayed || !library[part.candidate.mechanism].states.is_empty()
    });
    // Where nothing but white noise is left, what a memory explains is explained.
    let doubtful = remembers && !improved.leaves_white_noise(scale);
    if doubtful {
        free.gain > IMITATES_MEMORY * named
    } else {
        free.gain > IMITATES_LAW * named && t > STEADY_SHAPE
    }
}

/// What the improved model leaves over.
pub(crate) struct ResidualDiagnostics {
    /// Largest residual RMS over the noise.
    misfit: f64,
    /// A channel's residual is well above the noise, correlated, and no coloured noise.
    slow: bool,
    /// Gain of free shapes on folds they were not fitted to (zero where it is not steady).
    shape: f64,
    /// Whether free shapes are likelier than none, however little they explain.
    hidden: bool,
    /// They are, and explain about as much in every fold.
    steady: bool,
    /// They are, and the innovations are all there is to judge by.
    innovations: bool,
    /// Share of the calibrated model's misfit beyond the noise that the mechanisms explain.
    explained: f64,
}

impl ResidualDiagnostics {
    pub(crate) fn of(
        improved: &FittedModel,
        found: &Found,
        comparable: &impl Deref<Target = (FittedModel, FittedModel)>,
        discrepancy: Option<&Discrepancy>,
        base: f64,
    ) -> ResidualDiagnostics {
        let scale = &found.scale;
        let sigma = &improved.setup.data.sigma;
        let rms = raw_rms(improved, scale);
        let coloured = crate::search::coloured_channels(improved, scale);
        let misfit = rms.iter().zip(sigma).map(|(r, s)| r / s).fold(0.0, f64::max);
        let ratios = effective_sample_ratio(improved.at(scale));
        let slow = (0..rms.len()).any(|c| {
            let over = rms[c] / sigma[c];
            !coloured[c] && (over > MISFIT || (over > SLOW_MISFIT && ratios[c] < SLOW))
        });
        let shape = discrepancy.filter(|s| s.t > 2.5).map_or(0.0, |s| s.gain);
        // The floor is the noise where it is white, the residual itself where it passes for noise.
        let counts = &improved.fit.count;
        let floor: f64 = (0..rms.len())
            .map(|c| {
                let noise = if coloured[c] { rms[c] } else { sigma[c].min(rms[c]) };
                counts[c] as f64 * (noise / scale[c]).powi(2)
            })
            .sum();
        let full: f64 = raw_rss(improved, scale).iter().sum();
        let mut explained = 1.0 - (full - floor).max(0.0) / (base - floor).max(1e-300);
        let whitened = found.improved.setup.noise.is_some();
        // Free shapes' gain in log-likelihood, by what independent samples there are.
        let likelier = discrepancy.filter(|s| {
            s.t > STEADY_DOUBT && s.samples as f64 * s.effective_sample_ratio * s.gain > LIKELIER
        });
        let hidden = likelier.is_some();
        let steady = likelier.is_some_and(|s| s.t > STEADY_SHAPE);
        let predictable = likelier.filter(|s| whitened && s.t > STEADY_INNOVATIONS);
        let innovations = predictable.is_some();
        if let Some(free) = predictable {
            // What the mechanisms gain in log-likelihood per sample beside what free shapes would gain beyond
            // them.
            let (before, after) = &**comparable;
            let seen = after.fit.count.iter().sum::<usize>().max(1) as f64;
            let named = log_likelihood_gain(before, after, scale) / seen;
            explained = named / (named - (1.0 - free.gain).max(1e-9).ln()).max(1e-300);
        }
        ResidualDiagnostics { misfit, slow, shape, hidden, steady, innovations, explained }
    }

    /// Whether something is missing beyond the mechanisms found.
    pub(crate) fn significant(&self, mechanisms: usize) -> bool {
        let (gain, ratio) = if mechanisms == 0 { (0.2, 1.3) } else { (0.05, 1.1) };
        self.slow || self.hidden || (self.shape > gain && self.misfit > ratio)
    }

    fn verdict(&self, mechanisms: usize) -> Verdict {
        let lacks = self.slow || self.innovations || (self.shape > 0.2 && self.misfit > 1.3);
        match mechanisms {
            0 if lacks => Verdict::Unexplained,
            0 => Verdict::Consistent,
            _ if lacks && self.explained < 0.9 => Verdict::Unexplained,
            _ => Verdict::MissingPhysics,
        }
    }
}

/// What free shapes explain of a residual.
pub(crate) fn discrepancy_of(fitted: &FittedModel, scale: &[f64]) -> Option<Discrepancy> {
    crate::discrepancy::test(fitted.at(scale))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::built_in;
    use crate::closure::tests::{bodies, nothing, with_forces};

    /// A law without a name that does the work of names better leaves those of its own family: springs that imitate a damper
    /// of one side are not believed, a drag that imitates a cube of the speed stands for its family.
    #[test]
    fn a_name_stands_where_what_outdoes_it_is_of_its_family() {
        let library = built_in().unwrap();
        let named = |kinds: &[&str], more: &dyn Fn([f64; 5]) -> [f64; 3]| {
            let search = Search::new(bodies(more, 61), &library, &crate::Quiet);
            let found = nothing(&search);
            let improved = with_forces(&search, &found, kinds);
            let found = Found { improved, ..found };
            let judged = Judged::of(
                &search,
                &found,
                &found.improved,
                &found.scale,
                (&found.calibrated, &|_| true),
                &library,
            );
            let outdone: Vec<bool> = judged.outdone.iter().map(|laws| !laws.is_empty()).collect();
            (judged.verdict, judged.named, outdone)
        };
        let damper = |[_, _, v, ..]: [f64; 5]| [0.1 * v.abs(), 0.0, 0.0];
        let springs = named(&["quadratic_stiffness"], &damper);
        assert_eq!(springs, (Verdict::Unexplained, vec![false], vec![true]));
        let cube = |[_, _, v, ..]: [f64; 5]| [0.02 * v.powi(3), 0.0, 0.0];
        let friction = named(&["quadratic_drag"], &cube);
        assert_eq!(friction, (Verdict::MissingPhysics, vec![true], vec![true]));
        let dry = |[_, _, v, ..]: [f64; 5]| [0.8 * f64::tanh(1e3 * v), 0.0, 0.0];
        assert_eq!(named(&["coulomb_friction"], &dry), (Verdict::MissingPhysics, vec![true], vec![false]));
    }
}
