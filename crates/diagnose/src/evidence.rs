//! How much better one fitted model is than another, and whether that is believable.
//!
//! Residuals of real machines are correlated; the number of samples then overstates the information.
//! With the autocorrelation ρ of the better model's residual, channel c counts as
//!
//! ```text
//! N_eff = Σ n_c κ_c,   κ_c = 1 / (1 + 2 Σ_k ρ_c(k))      (until ρ < 0.05)
//! score = Σ n_c κ_c ln(RSS_old/RSS_new) − penalty(k, N_eff) − 2·surcharge,   penalty ≈ k ln N_eff
//! ```
//!
//! Consistency is judged on ten folds of contiguous blocks: leaving fold k out moves the parameters, to
//! first order, by δ = −(H − H_k)⁻¹ s_k; what that does to fold k's own residual is its held-out error.
//!
//! Beside it stands one quantity that could take the place of the score's κ and of all conditions on folds. It decides which
//! terms a closure holds, and nothing else yet. It asks for the strength θ of the law itself: with the covariance S that the
//! residual gives it (`uncertainty.rs`), S₀ in white noise, and V, what a fit of unit variance knows of it,
//!
//! ```text
//! c = tr(V⁻¹ S) / tr(V⁻¹ S₀),  at least 1      (Godambe, Ann. Math. Stat. 31, 1960)
//! robust = (ν + γ) ln(1 + Σ n_c ln(RSS_old/RSS_new) / (c ν)) − penalty(k, n/c) − 2·surcharge
//! ```
//!
//! the ratio of likelihoods adjusted by c (Chandler and Bate, Biometrika 94, 2007). S is that of stationary noise
//! (ν = ∞: the first term is the sum over c), or of the scores of some forty blocks of samples where that is larger; then
//! c is known with ν degrees of freedom, and the ratio is Student's in γ dimensions, those of θ less what priors decide of
//! them (MacKay, Neural Computation 4, 1992). A free shape has priors: it is one parameter, its size, and costs
//! |s|²/c − ln |V| besides ([`Smoothness`]). A law that is right only here and there, or whose gain
//! a slow misfit makes, has a large c, however large the gain.

use greybox_calibrate::{FitPoint, qr};

use crate::screen::project;

/// Number of folds.
pub const FOLDS: usize = 10;

/// Held-out error per fold, and what it takes to compute it.
#[derive(Debug, Clone)]
pub struct Folds {
    /// Held-out sum of squares per fold.
    pub sse: Vec<f64>,
    /// Sum of squares per block at the optimum.
    pub blocks: Vec<f64>,
}

/// Comparison of a richer model with a simpler one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evidence {
    /// Log-likelihood gain less the penalty of complexity.
    pub score: f64,
    /// The same at Akaike's penalty, two for each parameter.
    pub akaike: f64,
    /// Relative drop of the residual sum of squares.
    pub drop: f64,
    /// Relative drop of the held-out sum of squares.
    pub cross_validation_gain: f64,
    /// Mean over standard error of the folds' drops.
    pub t: f64,
    /// Share of the folds that improve.
    pub improved_fold_fraction: f64,
    /// Smallest κ over the channels.
    pub effective_sample_ratio: f64,
    /// Of all changes in the blocks' sums of squares, the share that is for the better: near one where an
    /// effect acts rarely and nothing else suffers for it.
    pub improvement_concentration: f64,
    /// The residuals were whitened.
    pub whitened: bool,
}

impl Evidence {
    /// No evidence.
    pub const NONE: Evidence = Evidence {
        score: 0.0,
        akaike: 0.0,
        drop: 0.0,
        cross_validation_gain: 0.0,
        t: 0.0,
        improved_fold_fraction: 0.0,
        effective_sample_ratio: 1.0,
        improvement_concentration: 0.0,
        whitened: false,
    };
}

/// κ per channel: information per sample of an autocorrelated residual.
pub fn effective_sample_ratio(at: FitPoint<'_>) -> Vec<f64> {
    let FitPoint { setup, level, scale, point } = at;
    let rows = setup.with_problem(level, scale, |p| p.rows(point, false, None));
    (0..setup.system.ny)
        .map(|c| {
            let series: Vec<&[f64]> = rows
                .iter()
                .zip(&level.segments)
                .map(|(r, s)| &r.r[c * s.range.len()..(c + 1) * s.range.len()])
                .collect();
            let power: f64 = series.iter().map(|s| qr::dot(s, s)).sum();
            let longest = series.iter().map(|s| s.len()).max().unwrap_or(0);
            if power <= 0.0 {
                return 1.0;
            }
            let mut sum = 0.0;
            for lag in 1..longest / 2 {
                let rho: f64 = series
                    .iter()
                    .filter(|s| s.len() > lag)
                    .map(|s| qr::dot(&s[lag..], &s[..s.len() - lag]))
                    .sum::<f64>()
                    / power;
                if rho < 0.05 {
                    break;
                }
                sum += rho;
            }
            1.0 / (1.0 + 2.0 * sum)
        })
        .collect()
}

/// The smallest κ over the channels.
pub fn least_effective_sample_ratio(at: FitPoint<'_>) -> f64 {
    effective_sample_ratio(at).into_iter().fold(1.0, f64::min)
}

/// Held-out errors by fold at the optimum of a fit.
pub fn folds(at: FitPoint<'_>) -> Folds {
    let FitPoint { setup, level, scale, point } = at;
    let (nx, ny, np) = (setup.system.nx, setup.system.ny, setup.free.len());
    let rows = setup.with_problem(level, scale, |p| p.rows(point, true, None));
    let total: usize = level.segments.iter().map(|s| s.range.len()).sum();
    // At least 20 blocks in all, whatever the number of segments.
    let length = (total / 40).max(1);
    let mut blocks: Vec<(f64, Vec<f64>, Vec<f64>)> = Vec::new(); // r'r, J'r, J'J
    for (segment, rows) in level.segments.iter().zip(rows) {
        let p = project(rows, nx);
        let (n, m) = (segment.range.len(), p.rows);
        let parts = (n as f64 / length as f64).round().max(1.0) as usize;
        for b in 0..parts {
            let (from, to) = (b * n / parts, (b + 1) * n / parts);
            let (mut rr, mut jr, mut jj) = (0.0, vec![0.0; np], vec![0.0; np * np]);
            for c in 0..ny {
                let part = |v: &[f64], column: usize| -> std::ops::Range<usize> {
                    debug_assert!(v.len() >= (column + 1) * m);
                    column * m + c * n + from..column * m + c * n + to
                };
                let r = &p.r[part(&p.r, 0)];
                rr += qr::dot(r, r);
                for i in 0..np {
                    let ji = &p.jp[part(&p.jp, i)];
                    jr[i] += qr::dot(ji, r);
                    for k in 0..=i {
                        let v = qr::dot(ji, &p.jp[part(&p.jp, k)]);
                        jj[i * np + k] += v;
                        if k != i {
                            jj[k * np + i] += v;
                        }
                    }
                }
            }
            blocks.push((rr, jr, jj));
        }
    }
    let mut h = vec![0.0; np * np];
    for (_, _, jj) in &blocks {
        h.iter_mut().zip(jj).for_each(|(a, b)| *a += b);
    }
    for (i, f) in setup.free.iter().enumerate() {
        h[i * np + i] += f.prior.precision(point.parameters[f.index]);
    }
    let d: Vec<f64> = (0..np).map(|i| if h[i * np + i] > 0.0 { h[i * np + i].sqrt() } else { 1.0 }).collect();
    let count = FOLDS.min(blocks.len().max(1));
    let sse = (0..count)
        .map(|k| {
            let (a, b) = (k * blocks.len() / count, (k + 1) * blocks.len() / count);
            let (mut rr, mut jr, mut jj) = (0.0, vec![0.0; np], vec![0.0; np * np]);
            for (r, s, hh) in &blocks[a..b] {
                rr += r;
                jr.iter_mut().zip(s).for_each(|(a, b)| *a += b);
                jj.iter_mut().zip(hh).for_each(|(a, b)| *a += b);
            }
            if np == 0 {
                return rr;
            }
            // Damped: a fold may hold the only activity of a parameter.
            let mut left: Vec<f64> = (0..np * np).map(|i| (h[i] - jj[i]) / (d[i / np] * d[i % np])).collect();
            for i in 0..np {
                left[i * np + i] += 0.01;
            }
            let rhs: Vec<f64> = jr.iter().zip(&d).map(|(s, d)| -s / d).collect();
            let delta: Vec<f64> = qr::solve_spd(&left, np, &rhs).iter().zip(&d).map(|(x, d)| x / d).collect();
            let mut sse = rr - 2.0 * qr::dot(&delta, &jr);
            for i in 0..np {
                sse += delta[i] * qr::dot(&jj[i * np..(i + 1) * np], &delta);
            }
            sse
        })
        .collect();
    Folds { sse, blocks: blocks.iter().map(|b| b.0).collect() }
}

/// By how much white noise overstates what the samples tell of some parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Inflation {
    /// The size of their covariance over that in white noise, at least 1.
    pub factor: f64,
    /// Degrees of freedom that it is known with: infinite in stationary noise, whose model has few parameters.
    pub freedom: f64,
    /// How many parameters there are, less what their priors decide.
    pub parameters: f64,
}

/// What a comparison knows of each of the two models.
pub struct ComparedModel {
    /// Residual sum of squares per channel (innovations, where the residual is whitened).
    pub rss: Vec<f64>,
    /// Parameters beyond the nominal ones.
    pub parameters: f64,
    /// Surcharges of its mechanisms.
    pub surcharge: f64,
    /// What its free shapes cost.
    pub shapes: Smoothness,
}

/// What free shapes cost: of changes of slope s that are normal with variance one before the fit, and with covariance V after
/// it, twice the logarithm of the marginal likelihood falls by |s|²/c − ln |V| (Laplace's approximation; c as in
/// [this module](self)).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Smoothness {
    /// |s|².
    pub squares: f64,
    /// −ln |V|.
    pub certainty: f64,
}

impl Smoothness {
    fn penalty(self, inflation: f64) -> f64 {
        self.squares / inflation + self.certainty
    }
}

/// Penalty of `k` parameters: BIC's ln N for each, no less than AIC's 2, and on little information more, by the
/// small-sample factor N/(N − k − 1) (Hurvich and Tsai 1989), three at most.
pub(crate) fn penalty(k: f64, information: f64) -> f64 {
    let n = information.max(2.0);
    k * n.ln().max(2.0) * n / (n - k - 1.0).max(n / 3.0)
}

/// Sum over the folds by which held-out errors fall, and the mean of the falls over its standard error.
pub fn cross_validation_improvement(from: &[f64], to: &[f64]) -> (f64, f64) {
    let differences: Vec<f64> = from.iter().zip(to).map(|(a, b)| a - b).collect();
    let (k, sum) = (differences.len().max(1) as f64, differences.iter().sum::<f64>());
    let mean = sum / k;
    let variance = differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / (k - 1.0).max(1.0);
    (sum, mean / (variance / k).sqrt().max(1e-300))
}

/// Σ n_c w_c ln(RSS_old/RSS_new) over the channels, and Σ n_c w_c.
fn gain(
    old: &ComparedModel,
    new: &ComparedModel,
    count: &[usize],
    weight: impl Fn(usize) -> f64,
) -> (f64, f64) {
    let (mut gain, mut information) = (0.0, 0.0);
    for c in 0..count.len() {
        let n = count[c] as f64 * weight(c);
        information += n;
        if new.rss[c] > 0.0 && old.rss[c] > 0.0 {
            gain += n * (old.rss[c] / new.rss[c]).ln();
        }
    }
    (gain, information)
}

/// The adjusted score of the richer model (`new`) over the simpler (`old`), both fitted with the same scale: `robust` in the
/// formula of [this module](self). `inflation` is that of what `new` has beyond `old`.
pub fn robust(old: &ComparedModel, new: &ComparedModel, count: &[usize], inflation: Inflation) -> f64 {
    let (gain, information) = gain(old, new, count, |_| 1.0 / inflation.factor);
    let freedom = inflation.freedom;
    let reported = match freedom.is_finite() && gain > 0.0 {
        true => (freedom + inflation.parameters) * (gain / freedom).ln_1p(),
        false => gain,
    };
    let cost =
        |side: &ComparedModel| penalty(side.parameters, information) + side.shapes.penalty(inflation.factor);
    let dearer = cost(new) - cost(old);
    reported - dearer - 2.0 * (new.surcharge - old.surcharge)
}

/// Weighs the richer model (`new`) against the simpler (`old`), both fitted with the same scale, by what the samples tell and
/// by the errors of either on folds.
pub fn weigh(
    (old, old_folds): (&ComparedModel, &Folds),
    (new, new_folds): (&ComparedModel, &Folds),
    count: &[usize],
    effective_sample_ratio: &[f64],
    whitened: bool,
) -> Evidence {
    let (gain, effective) = gain(old, new, count, |c| effective_sample_ratio[c]);
    let gain = gain - 2.0 * (new.surcharge - old.surcharge);
    let (before, after): (f64, f64) = (old.rss.iter().sum(), new.rss.iter().sum());
    let (fallen, t) = cross_validation_improvement(&old_folds.sse, &new_folds.sse);
    let better = old_folds.sse.iter().zip(&new_folds.sse).filter(|(a, b)| *a - *b > 0.0).count();
    let changes = || old_folds.blocks.iter().zip(&new_folds.blocks).map(|(a, b)| a - b);
    let all: f64 = changes().map(f64::abs).sum();
    Evidence {
        score: gain + penalty(old.parameters, effective) - penalty(new.parameters, effective),
        akaike: gain + 2.0 * (old.parameters - new.parameters),
        drop: 1.0 - after / before.max(1e-300),
        cross_validation_gain: fallen / old_folds.sse.iter().sum::<f64>().max(1e-300),
        t,
        improved_fold_fraction: better as f64 / old_folds.sse.len().max(1) as f64,
        effective_sample_ratio: effective_sample_ratio.iter().copied().fold(1.0, f64::min),
        improvement_concentration: changes().map(|d| d.max(0.0)).sum::<f64>() / all.max(1e-300),
        whitened,
    }
}

#[cfg(test)]
mod tests {
    use super::{ComparedModel, Folds, Inflation, Smoothness, penalty, robust, weigh};

    fn side(rss: f64, parameters: f64) -> ComparedModel {
        ComparedModel { rss: vec![rss], parameters, surcharge: 0.0, shapes: Smoothness::default() }
    }

    #[test]
    fn the_criteria_differ_by_their_price_alone() {
        let n = 1000;
        let folds = |rss: f64| Folds { sse: vec![rss / 10.0; 10], blocks: vec![rss / 20.0; 20] };
        let (simple, rich) = (folds(1010.0), folds(1000.0));
        let e = weigh((&side(1010.0, 1.0), &simple), (&side(1000.0, 3.0), &rich), &[n], &[1.0], false);
        let gain = 1000.0 * 1.01_f64.ln();
        assert!((e.akaike - (gain - 4.0)).abs() < 1e-9, "{}", e.akaike);
        assert!((e.score - (gain - penalty(3.0, 1000.0) + penalty(1.0, 1000.0))).abs() < 1e-9, "{}", e.score);
        // Two parameters for a gain of ten: BIC refuses what Akaike accepts.
        assert!(e.score < 0.0 && e.akaike > 0.0);
    }

    /// The same gain: from white noise, and where the strength is known twenty times less.
    #[test]
    fn what_a_slow_misfit_makes_is_worth_less() {
        let of = |factor, freedom| {
            robust(
                &side(1200.0, 0.0),
                &side(1000.0, 1.0),
                &[1000],
                Inflation { factor, freedom, parameters: 1.0 },
            )
        };
        let gain = 1000.0 * 1.2_f64.ln();
        let student = |gain: f64, n: f64| 40.0 * (1.0 + gain / 39.0).ln() - penalty(1.0, n);
        assert!((of(1.0, 39.0) - student(gain, 1000.0)).abs() < 1e-9);
        let slow = of(20.0, 39.0);
        assert!((slow - student(gain / 20.0, 50.0)).abs() < 1e-9 && slow < 6.0, "{slow}");
        // Of much freedom, Student's ratio is that of a normal.
        let [many, all] = [1e7, f64::INFINITY].map(|freedom| of(1.0, freedom));
        assert!(
            (all - (gain - penalty(1.0, 1000.0))).abs() < 1e-9 && (many - all).abs() < 0.01,
            "{many} {all}"
        );
        // Of three strengths Student's ratio has three dimensions; a prior's penalty falls with what the residual is worth.
        let three = Inflation { factor: 2.0, freedom: 39.0, parameters: 3.0 };
        let shaped =
            ComparedModel { shapes: Smoothness { squares: 8.0, certainty: 5.0 }, ..side(1000.0, 1.0) };
        let expected = 42.0 * (1.0 + gain / 78.0).ln() - penalty(1.0, 500.0) - (4.0 + 5.0);
        assert!((robust(&side(1200.0, 0.0), &shaped, &[1000], three) - expected).abs() < 1e-9);
        // What is worse is no better for it, and a surcharge is paid.
        let plain = Inflation { factor: 1.0, freedom: 39.0, parameters: 1.0 };
        let worse = robust(&side(1000.0, 0.0), &side(1100.0, 1.0), &[1000], plain);
        assert!(worse < -90.0, "{worse}");
        let dear = ComparedModel { surcharge: 3.0, ..side(1000.0, 1.0) };
        assert!((of(1.0, 39.0) - robust(&side(1200.0, 0.0), &dear, &[1000], plain) - 6.0).abs() < 1e-9);
    }

    #[test]
    fn parameters_cost_as_bic_says_and_more_where_little_is_known() {
        // Much information: k ln N, to the factor N/(N − k − 1).
        assert!((penalty(3.0, 1e5) / (3.0 * 1e5_f64.ln()) - 1.0).abs() < 1e-4);
        assert!(penalty(0.0, 50.0).abs() < 1e-300);
        // Hurvich and Tsai's factor at N = 20, k = 4: 20/15.
        assert!((penalty(4.0, 20.0) - 4.0 * 20_f64.ln() * 20.0 / 15.0).abs() < 1e-12);
        // Below e² samples AIC's 2, and the factor three at most.
        assert!((penalty(2.0, 6.0) - 2.0 * 2.0 * 6.0 / 3.0).abs() < 1e-12);
        assert!((penalty(5.0, 6.0) - 5.0 * 2.0 * 3.0).abs() < 1e-12);
    }
}
