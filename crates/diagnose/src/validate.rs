//! Cross-validation: how well a model simulates what it was not fitted to.
//!
//! Recordings are left out one by one. The second half of a single one is cut into contiguous blocks, and each is predicted
//! from all that was before it: less than half a recording says little of a model, what is asked of a model is the next
//! experiment, and blocks on both sides of a gap tell more of it than any past does (rolling origin; Hyndman and
//! Athanasopoulos, *Forecasting: Principles and Practice*, section 5.10). The parameters are refitted without the fold, which
//! is then simulated from a state estimated on its first quarter (Stone, *Cross-validatory choice and assessment of
//! statistical predictions*, J. R. Stat. Soc. B 36, 1974; contiguous folds since neighbouring samples tell of each other).
//!
//! Two or three folds are too few to tell a gain from chance: Student's quantile of one degree of freedom is 6.3. Each is then
//! judged in contiguous parts, so that two recordings say no less than the four blocks of a single one.

use std::ops::Range;

use greybox_calibrate::{Criterion, Data, Limits, Point, Segment, Segmentation, Setup};
use rayon::prelude::*;
use statrs::distribution::{ContinuousCDF, StudentsT};

use crate::fitted::FittedModel;

/// Most folds of several recordings; a single one has one less.
const FOLDS: usize = 5;
/// Shortest stretch that is fitted, samples.
const SHORTEST: usize = 8;
/// Steps of a refit.
const REFIT: Limits = Limits { iterations: 10, tolerance: 1e-5 };

/// What is left out together: stretches of pieces.
pub(crate) type Fold = Vec<(usize, Range<usize>)>;

/// The folds of the training data.
pub(crate) fn folds(data: &Data) -> Vec<Fold> {
    let recordings = data.recordings.len();
    if recordings > 1 {
        let mut folds = vec![Fold::new(); recordings.min(FOLDS)];
        let count = folds.len();
        for (i, piece) in data.pieces.iter().enumerate() {
            folds[piece.recording % count].push((i, 0..piece.len));
        }
        folds.retain(|f| !f.is_empty());
        return folds;
    }
    let whole: Fold = data.pieces.iter().enumerate().map(|(i, piece)| (i, 0..piece.len)).collect();
    let total = data.samples();
    let first = total / 2;
    let blocks = ((total - first) / SHORTEST).clamp(1, FOLDS - 1);
    let at = |k: usize| first + k * (total - first) / blocks;
    let mut folds: Vec<Fold> = (0..blocks).map(|k| cut(&whole, at(k)..at(k + 1))).collect();
    folds.iter_mut().for_each(|fold| fold.retain(|(_, range)| range.len() >= SHORTEST));
    folds.retain(|f| !f.is_empty());
    folds
}

/// What these of a fold's samples, counted through its stretches, are of each.
fn cut(fold: &Fold, wanted: Range<usize>) -> Fold {
    let mut before = 0;
    let mut part = Fold::new();
    for (piece, range) in fold {
        let from = wanted.start.clamp(before, before + range.len()) - before;
        let to = wanted.end.clamp(before, before + range.len()) - before;
        if to > from {
            part.push((*piece, range.start + from..range.start + to));
        }
        before += range.len();
    }
    part
}

/// What is judged of the training data: the folds, or their parts where there are fewer than a single recording has blocks.
pub(crate) fn judged(data: &Data) -> Vec<Fold> {
    let folds = folds(data);
    let count = parts_each(&folds);
    folds.iter().flat_map(|fold| parts(fold, count)).collect()
}

/// Parts of each fold, so that there are no fewer than blocks of a single recording.
fn parts_each(folds: &[Fold]) -> usize {
    (FOLDS - 1).div_ceil(folds.len().max(1))
}

/// A fold in contiguous parts of as many samples each, none of them shorter than what is fitted.
fn parts(fold: &Fold, count: usize) -> Vec<Fold> {
    let total: usize = fold.iter().map(|(_, range)| range.len()).sum();
    let count = count.min(total / SHORTEST).max(1);
    (0..count).map(|k| cut(fold, k * total / count..(k + 1) * total / count)).collect()
}

/// The mean over the channels of ln(RMS error / spread) on each of the parts that are [judged], left out of the fit with the
/// fold that it is of; infinite where the simulation diverges.
pub(crate) fn errors(fitted: &FittedModel, scale: &[f64], criterion: Criterion, window: f64) -> Vec<f64> {
    let setup = &fitted.setup;
    let run = setup.free_run(&fitted.fit.point.parameters, scale);
    let window = match criterion {
        Criterion::FreeRun => f64::INFINITY,
        Criterion::Windowed => window,
    };
    let folds = folds(&setup.data);
    let count = parts_each(&folds);
    folds
        .par_iter()
        .flat_map_iter(|fold| {
            let level = without(setup, fold, longest(&fitted.level));
            let parameters = if level.segments.is_empty() || setup.free.is_empty() {
                fitted.fit.point.parameters.clone()
            } else {
                let point: Point = setup.stitch(&fitted.level, &fitted.fit.point, &level, scale);
                setup.fit(&level, scale, &[point], REFIT).point.parameters
            };
            let simulated: Vec<(usize, Range<usize>, Vec<f64>)> = fold
                .iter()
                .map(|(piece, range)| {
                    let y = setup.restarted(*piece, range.clone(), &run.x[*piece], &parameters, window);
                    (*piece, range.clone(), y)
                })
                .collect();
            parts(fold, count).into_iter().map(move |part| error(setup, &part, &simulated))
        })
        .collect()
}

/// The mean over the channels of ln(RMS error / spread) on a part of stretches that were simulated.
fn error(setup: &Setup, part: &Fold, simulated: &[(usize, Range<usize>, Vec<f64>)]) -> f64 {
    let ny = setup.system.ny;
    let (mut squares, mut counts) = (vec![0.0; ny], vec![0usize; ny]);
    for (piece, range) in part {
        let holds = |s: &&(usize, Range<usize>, Vec<f64>)| {
            s.0 == *piece && s.1.start <= range.start && range.end <= s.1.end
        };
        let Some((_, whole, y)) = simulated.iter().find(holds) else { continue };
        let (from, n) = (range.start - whole.start, whole.len());
        for c in 0..ny {
            let measured = &setup.data.pieces[*piece].measured[c][range.clone()];
            for (m, s) in measured.iter().zip(&y[c * n + from..c * n + from + range.len()]) {
                if !m.is_nan() {
                    squares[c] += (m - s).powi(2);
                    counts[c] += 1;
                }
            }
        }
    }
    let of = |c: usize| {
        let mean = squares[c] / counts[c].max(1) as f64;
        0.5 * (mean / setup.data.spread[c].powi(2)).max(f64::MIN_POSITIVE).ln()
    };
    let seen: Vec<usize> = (0..ny).filter(|&c| counts[c] > 0).collect();
    seen.iter().map(|&c| of(c)).sum::<f64>() / seen.len().max(1) as f64
}

fn longest(level: &Segmentation) -> usize {
    level.segments.iter().map(|s| s.range.len()).max().unwrap_or(SHORTEST).max(SHORTEST)
}

/// Segments of at most this length over all that a fold leaves.
fn without(setup: &Setup, fold: &Fold, length: usize) -> Segmentation {
    let single = setup.data.recordings.len() == 1;
    let last = fold.iter().map(|f| f.0).max().unwrap_or(0);
    let mut segments = Vec::new();
    for (piece, data) in setup.data.pieces.iter().enumerate() {
        let mut from = 0;
        let mut gaps: Vec<Range<usize>> = fold.iter().filter(|f| f.0 == piece).map(|f| f.1.clone()).collect();
        gaps.sort_by_key(|r| r.start);
        if single && piece > last {
            break;
        }
        gaps.push(data.len..data.len);
        for gap in gaps {
            let stretch = gap.start.saturating_sub(from);
            if stretch >= SHORTEST {
                let parts = stretch.div_ceil(length);
                for i in 0..parts {
                    let (a, b) = (from + i * stretch / parts, from + (i + 1) * stretch / parts);
                    segments.push(Segment { piece, range: a..b });
                }
            }
            // Of the recording itself only what was before.
            from = if single { data.len } else { gap.end };
        }
    }
    let priors = segments.iter().map(|s| setup.start_prior(s.piece, s.range.start)).collect();
    Segmentation { segments, priors }
}

/// What cross-validation says of a model beside a simpler one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Gain {
    /// Mean over the folds of ln(error of the simpler model / error of this one).
    pub(crate) mean: f64,
    /// Mean over standard error.
    pub(crate) t: f64,
    /// What `t` stays below by chance, in 95 of a hundred cases, where the model gains nothing: Student's quantile for so
    /// many folds.
    pub(crate) by_chance: f64,
    /// The gain on the fold that loses most.
    pub(crate) worst: f64,
}

impl Gain {
    /// From the errors of both on the same folds. Where the simpler model diverges and this one does not, the gain is as
    /// large as can be.
    pub(crate) fn of(simpler: &[f64], model: &[f64]) -> Gain {
        /// ln of the largest ratio that counts.
        const MOST: f64 = 7.0;
        let gains: Vec<f64> = simpler
            .iter()
            .zip(model)
            .map(|(a, b)| match (a.is_finite(), b.is_finite()) {
                (true, true) => (a - b).clamp(-MOST, MOST),
                (false, true) => MOST,
                (true, false) => -MOST,
                (false, false) => 0.0,
            })
            .collect();
        let n = gains.len().max(1) as f64;
        let mean = gains.iter().sum::<f64>() / n;
        let variance = gains.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        let t = mean / (variance / n).sqrt().max(1e-12);
        let by_chance = StudentsT::new(0.0, 1.0, (n - 1.0).max(1.0))
            .map_or(f64::INFINITY, |s| s.inverse_cdf(1.0 - CHANCE));
        Gain { mean, t, by_chance, worst: gains.iter().copied().fold(f64::INFINITY, f64::min) }
    }

    /// Whether the model predicts what it was not fitted to better than chance, and nothing much worse.
    pub(crate) fn is_beyond_chance(&self) -> bool {
        self.mean > CLEAR && self.t > self.by_chance && self.worst > -WORST.ln()
    }
}

/// Largest ratio of errors on a fold that a model may lose.
const WORST: f64 = 1.25;
/// Gain in ln(error) that counts.
const CLEAR: f64 = 0.05;
/// Probability of a gain by chance alone that is taken for none.
const CHANCE: f64 = 0.05;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use greybox_model::Model;
    use greybox_recording::{Channel, Recording};

    const LAG: &str = "[states]\nx = {}\n[parameters]\na = { value = 1, unit = \"1/s\" }\n[equations]\nlag = \"x' + a*x = 0\"\n";

    /// Recordings of so many samples each.
    fn data(samples: &[usize]) -> Data {
        let recording = |(i, &n): (usize, &usize)| {
            let values = (0..n).map(|k| (0.1 * k as f64).sin()).collect();
            let channel = Channel { name: "x".into(), unit: None, values };
            let time = (0..n).map(|k| 0.1 * k as f64).collect();
            Recording::from_columns(&format!("{i}.csv"), time, vec![channel]).unwrap()
        };
        let recordings: Vec<Recording> = samples.iter().enumerate().map(recording).collect();
        Data::new(&Model::from_toml(LAG, "lag.toml").unwrap(), &recordings).unwrap()
    }

    #[test]
    fn the_origin_of_a_single_recording_rolls_over_its_second_half() {
        assert_eq!(
            folds(&data(&[400])),
            [[(0, 200..250)], [(0, 250..300)], [(0, 300..350)], [(0, 350..400)]]
        );
        // Of a short one in as many blocks as have samples enough to be simulated.
        assert_eq!(folds(&data(&[42])), [[(0, 21..31)], [(0, 31..42)]]);
    }

    #[test]
    fn several_recordings_are_left_out_one_by_one() {
        assert_eq!(folds(&data(&[30, 40, 50])), [[(0, 0..30)], [(1, 0..40)], [(2, 0..50)]]);
        let many = folds(&data(&[30; 7]));
        assert_eq!(many.len(), FOLDS);
        assert_eq!(many[1], [(1, 0..30), (6, 0..30)]);
    }

    /// Two recordings are judged in four parts, as a single one is in four blocks; four and more as they are.
    #[test]
    fn few_recordings_are_judged_in_parts() {
        assert_eq!(judged(&data(&[400, 40])), [[(0, 0..200)], [(0, 200..400)], [(1, 0..20)], [(1, 20..40)]]);
        assert_eq!(judged(&data(&[400])), folds(&data(&[400])));
        assert_eq!(judged(&data(&[30; 3])).len(), 6);
        for many in [4, 7] {
            assert_eq!(judged(&data(&vec![30; many])), folds(&data(&vec![30; many])));
        }
        // A part is never shorter than what is fitted.
        assert_eq!(judged(&data(&[100, 12])), [[(0, 0..50)], [(0, 50..100)], [(1, 0..12)]]);
        // Of several pieces by samples.
        let fold: Fold = vec![(3, 10..20), (5, 0..30)];
        assert_eq!(parts(&fold, 2), [vec![(3, 10..20), (5, 0..10)], vec![(5, 10..30)]]);
    }

    /// Errors of a fold's parts are those of its one simulation.
    #[test]
    fn a_part_is_judged_by_the_simulation_of_its_fold() {
        let data = Arc::new(data(&[40]));
        let model = Model::from_toml(LAG, "lag.toml").unwrap();
        let setup = Setup::new(&model, data.clone(), Vec::new()).unwrap();
        let measured = &data.pieces[0].measured[0];
        let simulated: Vec<f64> = (0..40).map(|k| measured[k] + if k < 20 { 0.1 } else { 0.4 }).collect();
        let whole = [(0, 0..40, simulated)];
        let of = |range: Range<usize>| error(&setup, &vec![(0, range)], &whole) + data.spread[0].ln();
        assert!((of(0..20) - 0.1f64.ln()).abs() < 1e-12 && (of(20..40) - 0.4f64.ln()).abs() < 1e-12);
        assert!((of(0..40) - 0.5 * 0.085f64.ln()).abs() < 1e-12);
    }

    /// Four folds of a room's temperature gained by a constant alone, and not in another month: gains that are positive
    /// in three of four are chance.
    #[test]
    fn three_gains_of_four_are_chance() {
        let gain = Gain::of(&[0.0; 4], &[-0.9, -0.6, -0.35, 0.06]);
        assert!(gain.t > 1.5 && gain.mean > CLEAR && !gain.is_beyond_chance(), "{gain:?}");
    }

    #[test]
    fn a_gain_counts_where_no_fold_loses() {
        let even = Gain::of(&[0.0, 0.0, 0.0, 0.0, 0.0], &[-0.5, -0.6, -0.4, -0.5, -0.5]);
        assert!(even.is_beyond_chance(), "{even:?}");
        // Sure on average, and a quarter worse on one recording.
        let lost = Gain::of(&[0.0; 5], &[-2.0, -2.0, -2.0, -2.0, 0.25]);
        assert!(lost.t > lost.by_chance && !lost.is_beyond_chance(), "{lost:?}");
        let chance = Gain::of(&[0.0; 5], &[-0.2, 0.1, 0.1, -0.1, 0.0]);
        assert!(!chance.is_beyond_chance(), "{chance:?}");
    }

    #[test]
    fn few_folds_must_agree_more_than_many() {
        let gains = |n: usize| -> Vec<f64> { (0..n).map(|k| -[0.05, 0.4, 0.6, 0.2][k % 4]).collect() };
        let few = Gain::of(&[0.0; 2], &gains(2));
        assert!((few.by_chance - 6.314).abs() < 1e-3, "Student's t of one degree of freedom: {few:?}");
        assert!(!few.is_beyond_chance());
        let many = Gain::of(&[0.0; 8], &gains(8));
        assert!((many.by_chance - 1.895).abs() < 1e-3 && many.is_beyond_chance(), "{many:?}");
    }

    #[test]
    fn what_diverges_has_lost() {
        let gain = Gain::of(&[0.0; 5], &[-1.0, -1.0, -1.0, -1.0, f64::INFINITY]);
        assert!(!gain.is_beyond_chance(), "{gain:?}");
        let gain = Gain::of(&[f64::INFINITY; 2], &[0.0; 2]);
        assert!(gain.is_beyond_chance(), "{gain:?}");
    }
}
