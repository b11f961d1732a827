//! Fits to growing horizons: from short segments to whole recordings without losing the phase.
//!
//! The output error over T seconds has minima about 1/T apart in frequency: a fit to a long record from parameters that
//! are off by more ends in the wrong one. A fit to half the horizon knows the frequency well enough to begin with: the
//! horizon doubles, each fit begins where the one before ended, until it spans whole pieces (Bock 1981; Ljung, *System
//! Identification*, 2nd edition, section 10.5, of local minima).

use crate::problem::{Fit, Limits, Point};
use crate::setup::{Segmentation, Setup};

/// Factor by which the horizon grows.
const GROWTH: usize = 2;

/// Steps that bring the starts of new segments to given parameters.
const STARTS: usize = 6;

/// A fit at one horizon.
#[derive(Debug, Clone)]
pub struct Horizon {
    /// The segments.
    pub level: Segmentation,
    /// The fit.
    pub fit: Fit,
}

impl Setup {
    /// Fits at horizons that double from that of `from` until they span whole pieces, shortest first; the last is that
    /// of whole pieces. `limits` are those of each fit.
    pub fn grow(&self, from: &Segmentation, point: &Point, scale: &[f64], limits: Limits) -> Vec<Horizon> {
        let longest = self.data.lengths().into_iter().max().unwrap_or(0);
        let mut length = from.segments.iter().map(|s| s.range.len()).max().unwrap_or(1).max(1);
        let (mut level, mut point) = (from.clone(), point.clone());
        let mut out = Vec::new();
        while length < longest {
            length = (GROWTH * length).min(longest);
            // A last step of less than the factor is not worth a fit.
            let next = if GROWTH * length > longest {
                length = longest;
                self.level(1)
            } else {
                self.windows(length, usize::MAX)
            };
            let fit = self.lengthen(&level, &point, &next, scale, limits);
            (level, point) = (next.clone(), fit.point.clone());
            out.push(Horizon { level: next, fit });
        }
        out
    }

    /// Fits at another level: from the stitched trajectory of a fit or from the measurements, whichever is better. The
    /// starts come first: parameters that fit elsewhere must not give way to starts that do not yet.
    pub fn lengthen(
        &self,
        from: &Segmentation,
        point: &Point,
        to: &Segmentation,
        scale: &[f64],
        limits: Limits,
    ) -> Fit {
        let stitched = self.stitch(from, point, to, scale);
        let measured =
            Point { parameters: point.parameters.clone(), starts: self.starts(to, &point.parameters) };
        let held = Setup { free: Vec::new(), ..self.clone() };
        let starts = Limits { iterations: STARTS, tolerance: limits.tolerance };
        let settled = held.fit(to, scale, &[stitched, measured], starts).point;
        self.fit(to, scale, &[settled], limits)
    }
}
