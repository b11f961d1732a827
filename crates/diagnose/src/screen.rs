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

mod gram;
mod response;

use gram::Projection;
pub use gram::{Gram, Projected, gram, project};
pub(crate) use response::lanes;
pub use response::{
    CandidateResponses, Component, Variant, effect, first_states, first_values, inner_scales, signals,
};

use std::ops::Range;

use greybox_calibrate::{FitPoint, qr};
use rayon::prelude::*;

use crate::candidate::Candidate;
use crate::library::Mechanism;
use crate::marginal::log_marginal;
use crate::spectra::Spectra;
use crate::trajectory::{Cover, TrajectoryEval};

/// Share of a column's sum of squares that the model's own parameters must leave over: a column with less is
/// collinear with a parameter, and its coefficient would be rounding.
const INDEPENDENT: f64 = 3e-4;
/// What is added to the size of each column of a set, that of two alike neither grows beyond all bounds; and where the
/// columns explain a hundred million times what is left, so that any more would be seen in that.
const RIDGE: f64 = 1e-6;
const LEAST_RIDGE: f64 = 1e-12;

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

/// Least share that a pair must explain, and least surplus over its members alone.
const PAIR_GAIN: f64 = 0.05;

/// The columns of all candidates around a fit.
fn lanes_at(at: FitPoint<'_>, library: &[Mechanism], candidates: &[Candidate]) -> CandidateResponses {
    let FitPoint { setup, level, .. } = at;
    let (along, forces) = TrajectoryEval::observed(at);
    let spectra = Spectra::new(at, &along, &forces);
    lanes(setup, library, candidates, &along, &spectra, &Cover::of(setup, level))
}

/// The same with the products of each variant's own responses.
fn variants_at(
    at: FitPoint<'_>,
    library: &[Mechanism],
    candidates: &[Candidate],
) -> (CandidateResponses, Gram) {
    let lanes = lanes_at(at, library, candidates);
    let blocks: Vec<Range<usize>> = lanes.variants.iter().map(|v| v.columns.clone()).collect();
    let gram = gram(at, &lanes.signals, &lanes.columns, blocks);
    (lanes, gram)
}

/// The same with the products of all responses with each other.
fn responses(
    at: FitPoint<'_>,
    library: &[Mechanism],
    candidates: &[Candidate],
) -> (CandidateResponses, Gram) {
    let lanes = lanes_at(at, library, candidates);
    let whole = 0..lanes.columns.len();
    let gram = gram(at, &lanes.signals, &lanes.columns, vec![whole]);
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
    fn new(at: FitPoint<'_>, library: &'a [Mechanism], candidates: &'a [Candidate]) -> Regressions<'a> {
        let (lanes, gram) = responses(at, library, candidates);
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
    at: FitPoint<'_>,
    library: &[Mechanism],
    candidates: &[Candidate],
    most: usize,
) -> Vec<Together> {
    let all = Regressions::new(at, library, candidates);
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
    at: FitPoint<'_>,
    library: &[Mechanism],
    candidates: &[Candidate],
    most: usize,
) -> Option<Together> {
    let all = Regressions::new(at, library, candidates);
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
    at: FitPoint<'_>,
    library: &[Mechanism],
    candidates: &[Candidate],
    weight: f64,
) -> Vec<Together> {
    let (lanes, gram) = variants_at(at, library, candidates);
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
        let tried = tried.map(|width| (log_marginal(&root, &gg, &gr, weight, width), width));
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
/// min over S of  Σ_{i ∈ S} penalty(i) + min over c, δ of ‖r + Σ_{held} vⱼ gⱼ − Σ_{i ∈ S} cᵢ gᵢ − J δ‖²
/// ```
///
/// with the residual r over its scale, the responses g of all candidates of one column, the held values v, and the
/// sensitivities J to all other free parameters. From what is held, each step takes the best of one term more, one less, or
/// another for one of them, for as long as the cost falls (stepwise selection with exchanges: Miller, *Subset Selection in
/// Regression*, 2002, §3.6). First order is good here because the forces of either choice add up to about the same.
/// `None` where what is held costs least, or one of its terms has no column of its own.
pub(crate) fn reselect(
    at: FitPoint<'_>,
    library: &[Mechanism],
    candidates: &[Candidate],
    held: &[Held],
    penalty: &(dyn Fn(&Candidate) -> f64 + Sync),
) -> Option<Together> {
    struct Told {
        cost: f64,
        coefficients: Vec<f64>,
        gain: f64,
    }
    let (lanes, gram) = responses(at, library, candidates);
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
    let reported = |chosen: &[usize]| -> Option<Told> {
        let columns: Vec<usize> = chosen.iter().map(|&v| variants[v].columns.start).collect();
        let positive: Vec<bool> = chosen.iter().flat_map(|&v| all.positive(&variants[v])).collect();
        let (coefficients, gain) = all.regress(&columns, &positive, LEAST_RIDGE)?;
        let paid: f64 = chosen.iter().map(|&v| penalty(&candidates[variants[v].candidate])).sum();
        Some(Told { cost: paid - gain * all.rr, coefficients, gain })
    };
    let mut best = (reported(&chosen)?, chosen.clone());
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
        let tried = moves.into_par_iter().filter_map(|set| Some((reported(&set)?, set)));
        let next = tried.min_by(|a, b| a.0.cost.total_cmp(&b.0.cost).then_with(|| a.1.cmp(&b.1)));
        match next {
            // (Less is rounding.)
            Some(next) if next.0.cost < own.cost - 1e-6 => best = next,
            _ => break,
        }
    }
    let (reported, set) = best;
    let is_same = set.len() == chosen.len() && set.iter().all(|v| chosen.contains(v));
    if is_same { None } else { all.together(&set, &reported.coefficients, reported.gain) }
}

/// First-order shift of the other free parameters when those at these positions go to zero from `values`.
pub fn shift_without(at: FitPoint<'_>, gone: &[(usize, f64)]) -> Vec<f64> {
    let gram = gram(at, &[], &[], Vec::new()).without(gone);
    gram.solve(&gram.jr)
}

/// Scores every candidate at the point of a fit, best first.
pub fn screen(at: FitPoint<'_>, library: &[Mechanism], candidates: &[Candidate]) -> Vec<Scored> {
    let (lanes, gram) = variants_at(at, library, candidates);
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
    use std::sync::Arc;

    use greybox_calibrate::{Data, Point, Setup, free_parameters};
    use greybox_model::Model;
    use greybox_recording::{Channel, Recording};
    use greybox_simulate::Method;

    use super::*;
    use crate::candidate::candidates;
    use crate::place::places;

    /// Where the segments see a part of the recording, what the laws do there is all that is kept, and the products are the same.
    #[test]
    fn laws_are_kept_where_segments_see_them() {
        let text = r#"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.1, unit = "kg" }
c = { value = 0.5, unit = "N s/m" }
k = { value = 38.0, unit = "N/m" }
[equations]
mass = "m*x'' + c*x' + k*x = f"
"#;
        let model = Model::from_toml(text, "m.toml").unwrap();
        let time: Vec<f64> = (0..2400).map(|k| 0.01 * f64::from(k)).collect();
        let column = |name: &str, unit: &str, value: &dyn Fn(f64) -> f64| Channel {
            name: name.into(),
            unit: Some(unit.into()),
            values: time.iter().map(|t| value(*t)).collect(),
        };
        let f = column("f", "N", &|t| 20.0 * (4.0 * t).sin() + 9.0 * (7.3 * t).cos());
        let x = column("x", "m", &|t| 0.5 * (4.0 * t - 0.3).sin() + 0.2 * (7.3 * t).sin());
        let recording = Recording::from_columns("r", time.clone(), vec![f, x]).unwrap();
        let data = Arc::new(Data::new(&model, &[recording]).unwrap());
        let library = crate::built_in().unwrap();
        let all = candidates(&model, &library, &places(&model));
        for method in [Method::Rk4 { substeps: 1 }, Method::Rk4Stride { samples: 4 }] {
            let mut setup = Setup::new(&model, data.clone(), free_parameters(&model)).unwrap();
            setup.method = method;
            let level = setup.windows(60, 480);
            let values = setup.values();
            let point = Point { starts: setup.starts(&level, &values), parameters: values };
            let scale = setup.data.spread.clone();
            let at = FitPoint { setup: &setup, level: &level, scale: &scale, point: &point };
            let (along, forces) = TrajectoryEval::observed(at);
            let spectra = Spectra::new(at, &along, &forces);
            let of = |cover: &Cover| {
                let lanes = lanes(&setup, &library, &all, &along, &spectra, cover);
                let blocks = lanes.variants.iter().map(|v| v.columns.clone()).collect();
                let gram = gram(at, &lanes.signals, &lanes.columns, blocks);
                let inner: Vec<_> = lanes.variants.iter().map(|v| (v.candidate, v.inner.clone())).collect();
                (inner, lanes.signals[0].force.len(), gram)
            };
            let (whole, part) = (of(&Cover::default()), of(&Cover::of(&setup, &level)));
            assert_eq!(whole.0, part.0);
            assert!(whole.0.len() > 50 && 4 * part.1 < whole.1, "{} {} {}", whole.0.len(), part.1, whole.1);
            assert_eq!((whole.2.gr, whole.2.jg, whole.2.gg), (part.2.gr, part.2.jg, part.2.gg), "{method:?}");
        }
    }

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
