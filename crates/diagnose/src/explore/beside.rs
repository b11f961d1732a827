//! Something else: a [force of free shape](crate::shapes) beside the laws of a hypothesis, or in the place of some.
//!
//! Forces enter the innovations linearly. To first order, with the errors that the whole hypothesis has, one table of inner
//! products tells the evidence of every shape with and without every law:
//!
//! ```text
//! Z(laws, shape)/Z(laws)     = exp(ΔlnZ of the shape)/N
//! Z(others, shape)/Z(laws)   = exp(ΔlnZ of the shape, on the innovations plus what the others lack) / N
//!                              · Z(others)/Z(laws)
//! ```
//!
//! A law's effect is evaluated along the same trajectory as the shapes, and stands in the place of its strengths: what
//! replaces a law is compared with it there. Each shape is one of N candidates.

use greybox_calibrate::stochastic::Filter;
use greybox_calibrate::{FitPoint, Point, Segmentation};

use super::{Hypothesis, Known, innovations};
use crate::library::Mechanism;
use crate::marginal::log_sum;
use crate::screen::{Gram, effect, signals};
use crate::shapes::{Group, Shapes};
use crate::trajectory::TrajectoryEval;

/// Forces of free shape beside a hypothesis.
pub(super) struct Beside<'h> {
    h: &'h Hypothesis,
    /// How much the likelihood overstates what the samples tell.
    inflation: f64,
    /// ln N.
    penalty: f64,
    /// Of the innovations, the sensitivities and the laws' effects, and the shapes.
    gram: Gram,
    /// The column of each law's effect, behind those of the parameters.
    effects: Vec<Option<usize>>,
    /// With the deviation of their values before the data: all the force that their equation balances.
    shapes: Vec<(f64, Group)>,
}

impl<'h> Beside<'h> {
    /// Beside a hypothesis with segments over all data. `None` where nothing moves, or where the filter cannot follow.
    pub(super) fn of(
        h: &'h Hypothesis,
        filter: &Filter,
        library: &[Mechanism],
        (level, point): &(Segmentation, Point),
        inflation: f64,
        candidates: usize,
    ) -> Option<Beside<'h>> {
        let at = h.at();
        let setup = &at.setup;
        let noise = at.errors.noise();
        let along = TrajectoryEval::smoothed(FitPoint { setup, level, scale: &noise, point });
        let Shapes { groups, forces: mut added } = Shapes::along(setup, &along, 0.0)?;
        let (np, shapes) = (setup.free.len(), added.len());
        let mut lanes = Vec::new();
        let mut effects = Vec::new();
        for (candidate, values, _) in h.laws() {
            let parts = effect(setup, &library[candidate.mechanism], &candidate, &along, &values);
            effects.push(parts.as_ref().map(|_| np + lanes.len()));
            if let Some(parts) = parts {
                lanes.push(added.len()..added.len() + parts.len());
                added.extend(parts);
            }
        }
        let blocks: Vec<_> = groups.iter().map(|g| g.columns.clone()).collect();
        let columns: Vec<_> = (0..shapes).map(|l| l..l + 1).collect();
        let gram = innovations(filter, at, &signals(setup, &added), &lanes, &columns, &blocks)?;
        let total = along.total_forces();
        let width = |group: &Group| {
            let weights = group.variable.motion().weights.iter();
            let sizes = total.iter().zip(weights).filter(|(_, w)| **w != 0.0).map(|(t, w)| t / w.abs());
            sizes.fold(f64::INFINITY, f64::min)
        };
        let shapes = groups.into_iter().map(|g| (width(&g), g)).collect();
        Some(Beside { h, inflation, penalty: (candidates.max(1) as f64).ln(), gram, effects, shapes })
    }

    /// The inner products with some laws left out, and with the priors of the parameters that stay.
    fn without(&self, laws: &[usize]) -> Gram {
        let at = self.h.at();
        let free = &at.setup.free;
        let mut stays = vec![true; free.len()];
        let mut gone = Vec::new();
        for (law, effect) in self.effects.iter().enumerate() {
            let Some(column) = effect else { continue };
            let is_out = laws.contains(&law);
            let is_strength = |known: &Known| matches!(known, Known::Strength(_));
            let known = &self.h.known[law];
            let has_strength = known.iter().any(is_strength);
            for (a, known) in self.h.own(law).zip(known) {
                if is_out || !has_strength || is_strength(known) {
                    stays[a] = false;
                    gone.push((a, 0.0));
                }
            }
            if is_out {
                gone.push((*column, 1.0));
            }
        }
        let mut gram = self.gram.without(&gone);
        let kept: Vec<_> = free.iter().zip(stays).filter(|f| f.1).map(|f| f.0.clone()).collect();
        gram.add_priors(&kept, &at.parameters, 1.0 / self.inflation);
        gram
    }

    /// ln of the evidence with a shape, whichever, and without these laws, over that of the hypothesis. `None` where one of
    /// them cannot be evaluated along a trajectory.
    pub(super) fn evidence(&self, without: &[usize]) -> Option<f64> {
        if without.iter().any(|law| self.effects[*law].is_none()) {
            return None;
        }
        let gram = self.without(without);
        let gains = self.shapes.iter().enumerate().map(|(index, (width, group))| {
            let (gg, gr) = gram.projected(index);
            group.evidence(&gg, &gr, 1.0 / self.inflation, *width)
        });
        let shapes = log_sum(&gains.collect::<Vec<_>>()) - self.penalty;
        Some(shapes + self.laws(&gram, without) - self.laws(&self.without(&[]), &[]))
    }

    /// ln of the evidence of the laws that stay, up to what is the same for all of them.
    fn laws(&self, gram: &Gram, without: &[usize]) -> f64 {
        let stays = |a: usize| without.iter().all(|law| !self.h.own(*law).contains(&a));
        self.h.integral(self.inflation, stays) + without.len() as f64 * self.penalty
            - 0.5 * gram.remaining() / self.inflation
    }
}
