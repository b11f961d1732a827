//! Chapter 4: control of what was identified.

use anyhow::Result;

use super::Entry;
use super::{optimal, sliding};

/// Its tables and figures, in order.
pub(crate) fn entries() -> Vec<Entry> {
    vec![
        Entry::new("Figure 4.1", sliding::figure_4_1),
        Entry::new("Figure 4.2", sliding::figure_4_2),
        Entry::new("Figure 4.3", optimal::figure_4_3),
        Entry::new("Figure 4.4", optimal::figure_4_4),
        Entry::new("Figure 4.5", optimal::figure_4_5),
        Entry::new("Table 4.1", optimal::table_4_1),
        Entry::new("Figure 4.6", optimal::figure_4_6),
        Entry::new("Figure 4.7", optimal::figure_4_7),
        Entry::new("Figure 4.8", optimal::figure_4_8),
        Entry::new("Figure 4.9", optimal::figure_4_9).slow(),
        Entry::new("Figure 4.10", optimal::figure_4_10),
    ]
}

/// What a step on a square wave of ±`amplitude` looks like from its start to its end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Step {
    /// Time from which the error stays below 2 % of the step, s; not finite when it never does.
    pub(crate) settling: f64,
    /// How far it goes beyond the new value, % of the step.
    pub(crate) overshoot: f64,
    /// Error at the end, in the unit of the angle.
    pub(crate) left: f64,
}

impl Step {
    /// Of samples `dt` apart from a step of the reference from `before` to `after` on.
    pub(crate) fn of(angles: &[f64], dt: f64, before: f64, after: f64) -> Result<Self> {
        let size = after - before;
        anyhow::ensure!(!angles.is_empty() && size != 0.0, "no step to look at");
        let outside = angles.iter().rposition(|a| (a - after).abs() > 0.02 * size.abs());
        let settling = match outside {
            Some(k) if k + 1 == angles.len() => f64::INFINITY,
            Some(k) => (k + 1) as f64 * dt,
            None => 0.0,
        };
        let beyond = angles.iter().map(|a| (a - after) / size).fold(0.0, f64::max);
        let left = (angles[angles.len() - 1] - after).abs();
        Ok(Self { settling, overshoot: 100.0 * beyond, left })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_read_off() {
        let angles = [0.0, 5.0, 11.0, 10.1, 9.9];
        let step = Step::of(&angles, 0.5, 0.0, 10.0).unwrap();
        assert_eq!((step.settling, step.overshoot.round()), (1.5, 10.0));
        assert!((step.left - 0.1).abs() < 1e-12);
        // Downwards, and never within 2 %.
        let step = Step::of(&[0.0, -5.0], 0.5, 10.0, -10.0).unwrap();
        assert_eq!((step.settling, step.overshoot), (f64::INFINITY, 0.0));
        assert!(Step::of(&[], 0.5, 0.0, 1.0).is_err());
    }
}
