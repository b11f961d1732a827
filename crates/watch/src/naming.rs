//! Which single change explains the last blocks best, since when, and how large it is.

use crate::blocks::Scores;

/// Odds from which on one change is preferred to another.
const ODDS: f64 = 20.0;

/// What the last blocks say of one single change δ that began with one of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Explanation {
    pub(crate) effect: usize,
    /// Blocks since it began, by maximum likelihood.
    pub(crate) blocks: usize,
    /// δ, SI.
    pub(crate) step: f64,
    /// Its standard deviation where innovations are white and of variance one.
    pub(crate) std: f64,
    /// Twice the logarithm of the likelihood ratio, likewise.
    pub(crate) gain: f64,
    /// Mean square of the innovations that it leaves, and how many there are in a block.
    pub(crate) left: f64,
    pub(crate) samples: f64,
}

/// The explanation by one effect, of at most `most` blocks. A score has the mean `mean` while nothing changes: what is wrong
/// with the model at all times is no change.
fn explanation(history: &[Scores], effect: usize, mean: f64, most: usize) -> Explanation {
    let (mut gradient, mut information, mut squares, mut count) = (0.0, 0.0, 0.0, 0.0);
    let mut best =
        Explanation { effect, blocks: 1, step: 0.0, std: f64::INFINITY, gain: 0.0, left: 1.0, samples: 1.0 };
    for (k, block) in history.iter().rev().take(most.max(1)).enumerate() {
        gradient += block.gradient[effect] - mean * block.information[effect].sqrt();
        information += block.information[effect];
        squares += block.squares;
        count += block.count;
        let gain = gradient * gradient / information;
        if gain > best.gain {
            let (step, std) = (gradient / information, 1.0 / information.sqrt());
            let left = (squares - gain).max(0.0) / count;
            let blocks = k + 1;
            best = Explanation { effect, blocks, step, std, gain, left, samples: count / blocks as f64 };
        }
    }
    best
}

/// Explanations by every effect, the best first. Where one parameter, force or offset has changed, its own score is the
/// largest in the mean, by the inequality of Cauchy and Schwarz.
pub(crate) fn explanations(history: &[Scores], means: &[f64], most: usize) -> Vec<Explanation> {
    let effects = history.first().map_or(0, |s| s.gradient.len());
    let mut all: Vec<Explanation> =
        (0..effects).map(|effect| explanation(history, effect, means[effect], most)).collect();
    all.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    all
}

/// By how much the score of the best explanation scatters more than that of white innovations of variance one: `usual` while
/// nothing changes. What innovations have beyond that is systematic, the effect not being what the linearisation makes of it
/// (as in the block in which a change begins), and counts as one value a block (a quasi-likelihood with clusters:
/// P. McCullagh, J. A. Nelder, *Generalized Linear Models*, 1989, §9.2; K.-Y. Liang, S. L. Zeger, Biometrika 73, 1986).
pub(crate) fn dispersion(best: &Explanation, usual: f64) -> f64 {
    usual + (best.left - usual).max(0.0) * best.samples
}

/// Gain (twice the logarithm of a likelihood ratio) from which on an explanation is as likely as the best one, up to [`ODDS`].
fn least_gain(best: f64, dispersion: f64) -> f64 {
    best - 2.0 * ODDS.ln() * dispersion
}

/// The effects that the blocks do not tell from the best one.
pub(crate) fn alternatives(explanations: &[Explanation], usual: f64) -> impl Iterator<Item = usize> {
    let least = explanations.first().map_or(0.0, |e| least_gain(e.gain, dispersion(e, usual)));
    explanations.iter().skip(1).filter(move |e| e.gain > least).map(|e| e.effect)
}

/// The largest of some gains, and those that are as likely, the larger first.
pub(crate) fn likeliest(gains: &[f64]) -> (usize, Vec<usize>) {
    let mut order: Vec<usize> = (0..gains.len()).collect();
    order.sort_by(|a, b| gains[*b].total_cmp(&gains[*a]));
    let Some((most, others)) = order.split_first() else { return (0, Vec::new()) };
    let least = least_gain(gains[*most], 1.0);
    (*most, others.iter().copied().filter(|k| gains[*k] > least).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_data_do_not_tell_apart_is_listed() {
        assert_eq!(likeliest(&[1.0, 40.0, 9.0]), (1, vec![]));
        assert_eq!(likeliest(&[1.0, 4.0, 5.0]), (2, vec![1, 0]));
        assert_eq!(likeliest(&[]), (0, vec![]));
    }

    /// Blocks of information 4 (effect 0) and 1 (effect 1), which are correlated by 0.8; δ₀ = 3 since the last two.
    #[test]
    fn the_change_that_happened_explains_the_most() {
        let quiet =
            Scores { gradient: vec![0.1, -0.2], information: vec![4.0, 1.0], squares: 20.0, count: 20.0 };
        let loud = Scores {
            gradient: vec![12.0, 3.0 * 0.8 * 2.0],
            information: vec![4.0, 1.0],
            squares: 36.0 + 20.0,
            count: 20.0,
        };
        let history = [quiet.clone(), quiet, loud.clone(), loud];
        let all = explanations(&history, &[0.0; 2], 4);
        assert_eq!((all[0].effect, all[0].blocks, all[0].step), (0, 2, 3.0));
        assert!((all[0].std - 1.0 / 8f64.sqrt()).abs() < 1e-12 && (all[0].gain - 72.0).abs() < 1e-9);
        assert!((all[0].left - 1.0).abs() < 1e-12 && all[1].effect == 1);
        // Gains of 72 and 46: told apart where innovations are white, not where they scatter five times as much.
        assert_eq!(alternatives(&all, 1.0).count(), 0);
        assert_eq!(alternatives(&all, 5.0).collect::<Vec<_>>(), [1]);
        // A mean that is always there is no change.
        let means = [6.0, 4.8];
        assert!(explanations(&history[2..], &means, 2).iter().all(|e| e.gain < 1e-12));
    }
}
