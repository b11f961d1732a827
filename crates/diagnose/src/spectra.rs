//! First values for frequencies: where the residual's spectrum has lines.
//!
//! A ripple over position (cogging) or over time (a periodic disturbance) has a likelihood with very many
//! narrow maxima; no fit finds the right one from afar. Two spectra propose: that of the force which the
//! equation leaves over along the smoothed states (over position: Σ F e^{−i n q}, no even sampling needed),
//! and, over time, that of the residual of the outputs. A line counts by its power and by its power over
//! the running median of its neighbours. What is proposed goes through the score test like everything else.

use std::sync::Mutex;

use greybox_calibrate::{FitPoint, Point, Segmentation, Setup, qr};
use greybox_model::Expr;

use crate::candidate::Candidate;
use crate::locate::spectrum;
use crate::place::Place;
use crate::trajectory::TrajectoryEval;

/// Lines proposed by each spectrum, by power and again by prominence.
const LINES: usize = 6;
/// Neighbours of the running median.
const NEIGHBOURS: usize = 31;
/// Most values of the spectral variable that are tried.
const MOST: usize = 3000;
/// Share of an input's power around a frequency from which the input itself is periodic there.
const DRIVEN: f64 = 0.15;
/// Share of the power within ten lines that lies within two and a half where there is a line.
const LINE: f64 = 0.6;
/// Residual over the noise from which a model is far off.
const OFF: f64 = 20.0;
/// Most periods of a ripple over the range that are tried one by one beside coloured noise, and their steps.
const RIPPLES: f64 = 24.0;
const RIPPLE_STEP: f64 = 0.4;
/// Shortest period of a ripple over the noise of the sensor (1.7 steps where that is rounding).
const SENSED: f64 = 6.0;
/// Deviations beyond this many standard deviations are clipped.
const CLIP: f64 = 6.0;

/// Proposals of angular frequencies for the candidates of one screening.
pub struct Spectra<'a> {
    setup: &'a Setup,
    level: &'a Segmentation,
    scale: &'a [f64],
    point: &'a Point,
    along: &'a TrajectoryEval<'a>,
    /// The force that each equation lacks, `[piece][equation][sample]`.
    forces: &'a [Vec<Vec<f64>>],
    /// Those already made.
    known: Mutex<Vec<(Wanted, Vec<f64>)>>,
}

/// What a proposal is made for.
#[derive(Debug, Clone, PartialEq)]
struct Wanted {
    equation: usize,
    /// What the law swings over.
    variable: Expr,
    /// What it is multiplied by.
    carrier: Option<Expr>,
}

impl<'a> Spectra<'a> {
    /// For the model of `setup` at `point`.
    pub fn new(at: FitPoint<'a>, along: &'a TrajectoryEval<'a>, forces: &'a [Vec<Vec<f64>>]) -> Self {
        let FitPoint { setup, level, scale, point } = at;
        Spectra { setup, level, scale, point, along, forces, known: Mutex::new(Vec::new()) }
    }

    /// Angular frequencies over `variable` of a law that is multiplied by `carrier` (expressions in the mechanism's
    /// placeholders), strongest first.
    pub fn propose(&self, candidate: &Candidate, variable: &Expr, carrier: Option<&Expr>) -> Vec<f64> {
        let translate = |e: &Expr| candidate.translate(&self.setup.model, e, &|n| n.to_string());
        let equation = match &candidate.place {
            Place::Equation(e) => Some(*e),
            _ => candidate.motion().and_then(|m| m.weights.iter().position(|w| *w != 0.0)),
        };
        let Some(equation) = equation else { return Vec::new() };
        let wanted = Wanted { equation, variable: translate(variable), carrier: carrier.map(translate) };
        let found =
            |known: &Vec<(Wanted, Vec<f64>)>| known.iter().find(|k| k.0 == wanted).map(|k| k.1.clone());
        if let Ok(known) = self.known.lock()
            && let Some(values) = found(&known)
        {
            return values;
        }
        let values = self.lines_of(&wanted).unwrap_or_default();
        if let Ok(mut known) = self.known.lock() {
            known.push((wanted, values.clone()));
        }
        values
    }

    fn lines_of(&self, wanted: &Wanted) -> Option<Vec<f64>> {
        let mut force = self.force(wanted.equation);
        let over_time = wanted.variable == Expr::var("t");
        let Some(carrier) = &wanted.carrier else {
            return if over_time {
                Some(self.over_time(force.into_iter().chain(self.residuals())))
            } else {
                self.over(&force?, &wanted.variable)
            };
        };
        // c sin wt has, times c, a line at w: that of the mean of c².
        let carriers = self.along.eval(std::slice::from_ref(carrier), &[])?.pop()?;
        for (f, c) in force.iter_mut().flatten().flatten().zip(carriers.iter().flatten()) {
            *f *= if c.is_finite() { *c } else { 0.0 };
        }
        if over_time { Some(self.over_time(force.into_iter())) } else { self.over(&force?, &wanted.variable) }
    }

    /// The force that an equation leaves over, without its linear part, clipped.
    fn force(&self, equation: usize) -> Option<Vec<Vec<f64>>> {
        let force: Vec<&Vec<f64>> = self.forces.iter().map(|p| &p[equation]).collect();
        let model = &self.setup.model;
        let mut regressors = vec![Expr::Num(1.0)];
        for state in &model.states {
            regressors.extend((0..state.order.min(2)).map(|p| Expr::prime(&state.name, p as u8)));
        }
        regressors.extend(model.inputs.iter().map(|i| Expr::var(&i.name)));
        let columns = self.along.eval(&regressors, &[])?;
        let n: usize = force.iter().map(|f| f.len()).sum();
        let mut q: Vec<f64> = Vec::with_capacity(n * columns.len());
        for c in &columns {
            q.extend(c.iter().flatten().map(|v| if v.is_finite() { *v } else { 0.0 }));
        }
        qr::orthonormalise(&mut q, n, columns.len());
        let mut f: Vec<f64> =
            force.iter().copied().flatten().map(|v| if v.is_finite() { *v } else { 0.0 }).collect();
        qr::project_off(&q, n, &mut f);
        let limit = CLIP * (qr::dot(&f, &f) / n.max(1) as f64).sqrt();
        let mut rest = f.into_iter().map(|v| v.clamp(-limit, limit));
        Some(force.iter().map(|piece| rest.by_ref().take(piece.len()).collect()).collect())
    }

    /// Lines over time of several series `[piece][sample]`.
    fn over_time(&self, series: impl Iterator<Item = Vec<Vec<f64>>>) -> Vec<f64> {
        let mut values = Vec::new();
        for series in series {
            let pieces = &self.setup.data.pieces;
            let Some((x, piece)) = series.iter().zip(pieces).max_by_key(|(x, _)| x.len()) else { continue };
            let (frequency, power) = spectrum(x, piece.dt);
            // A window's main lobe is four lines wide: refine by the parabola through the peak.
            let step = frequency.get(1).copied().unwrap_or(0.0);
            for i in lines(&power) {
                let (a, b, c) = (power[i.max(1) - 1], power[i], power[(i + 1).min(power.len() - 1)]);
                let bend = a - 2.0 * b + c;
                let shift = if bend < 0.0 { (0.5 * (a - c) / bend).clamp(-0.5, 0.5) } else { 0.0 };
                values.push(2.0 * std::f64::consts::PI * step * (i as f64 + shift));
            }
        }
        // A frequency that the input itself is made of cannot be told from what the motion does.
        // A model far off leaves residual at every driven frequency, line or not.
        let off = self.scale.iter().zip(&self.setup.data.sigma).any(|(r, s)| *r > OFF * s);
        let taken = if off { moves } else { drives };
        let inputs = self.inputs();
        values.retain(|w| !inputs.iter().any(|(frequency, power)| taken(frequency, power, *w)));
        distinct(values)
    }

    /// Spectrum of each input on the longest piece: frequencies, Hz, and powers.
    fn inputs(&self) -> Vec<(Vec<f64>, Vec<f64>)> {
        let longest = self.setup.data.pieces.iter().max_by_key(|p| p.len);
        longest.map_or_else(Vec::new, |p| p.inputs.iter().map(|u| spectrum(u, p.dt)).collect())
    }

    /// Residuals of the outputs, `[channel][piece][sample]`.
    fn residuals(&self) -> Vec<Vec<Vec<f64>>> {
        let rows = self.setup.with_problem(self.level, self.scale, |p| p.rows(self.point, false, None));
        (0..self.setup.system.ny)
            .map(|c| {
                let mut out: Vec<Vec<f64>> =
                    self.setup.data.pieces.iter().map(|p| vec![0.0; p.len]).collect();
                for (segment, rows) in self.level.segments.iter().zip(&rows) {
                    let n = segment.range.len();
                    out[segment.piece][segment.range.clone()].copy_from_slice(&rows.r[c * n..(c + 1) * n]);
                }
                out
            })
            .collect()
    }

    /// Noise of the sensors that see a variable, added up; zero where none does.
    fn noise(&self, variable: &Expr) -> f64 {
        let channel = |name: &str| self.setup.model.measurement_of(name, 0);
        let channels = variable.variables().into_iter().filter_map(|(name, _)| channel(&name));
        channels.map(|c| self.setup.data.sigma[c]).sum()
    }

    /// Lines of a force over a variable that is not evenly sampled.
    fn over(&self, force: &[Vec<f64>], variable: &Expr) -> Option<Vec<f64>> {
        let q = self.along.eval(std::slice::from_ref(variable), &[])?.pop()?;
        let pairs: Vec<(f64, f64)> = q
            .iter()
            .flatten()
            .zip(force.iter().flatten())
            .filter(|(q, f)| q.is_finite() && f.is_finite())
            .map(|(q, f)| (*q, *f))
            .collect();
        let low = pairs.iter().fold(f64::INFINITY, |m, p| m.min(p.0));
        let high = pairs.iter().fold(f64::NEG_INFINITY, |m, p| m.max(p.0));
        if high <= low || pairs.is_empty() {
            return None;
        }
        let step = 0.4 / (high - low) * 2.0;
        // No finer than the samples resolve: half a turn of phase between neighbours.
        let mut jumps: Vec<f64> = q.iter().flat_map(|q| q.windows(2).map(|w| (w[1] - w[0]).abs())).collect();
        jumps.sort_by(f64::total_cmp);
        let jump = jumps.get(jumps.len() * 9 / 10).copied().unwrap_or(0.0);
        let finest = std::f64::consts::PI / jump.max(1e-300);
        // Nor than the sensor does: what it rounds to makes a ripple of its own, one step long.
        let finest = finest.min(2.0 * std::f64::consts::PI / (SENSED * self.noise(variable)).max(1e-300));
        let count = ((finest / step) as usize).clamp(8, MOST);
        // e^{−i n q} by rotation from one n to the next.
        let turns: Vec<(f64, f64)> =
            pairs.iter().map(|(q, _)| ((step * q).cos(), -(step * q).sin())).collect();
        let mut phasors: Vec<(f64, f64)> = vec![(1.0, 0.0); pairs.len()];
        let power: Vec<f64> = (0..count)
            .map(|_| {
                let (mut re, mut im) = (0.0, 0.0);
                for ((z, (c, s)), (_, f)) in phasors.iter_mut().zip(&turns).zip(&pairs) {
                    *z = (z.0 * c - z.1 * s, z.0 * s + z.1 * c);
                    re += z.0 * f;
                    im += z.1 * f;
                }
                re * re + im * im
            })
            .collect();
        let mut values: Vec<f64> = lines(&power).into_iter().map(|i| step * (i + 1) as f64).collect();
        if self.setup.noise.is_some() {
            // Beside coloured noise the force is too uncertain for lines: the score test looks at every ripple
            // of up to so many periods itself.
            let period = 2.0 * std::f64::consts::PI / (high - low);
            let turns = (1..).map(|i| f64::from(i) * RIPPLE_STEP).take_while(|t| *t <= RIPPLES);
            values.extend(turns.map(|t| t * period).filter(|n| *n <= step * count as f64));
        }
        Some(distinct(values))
    }
}

/// Indices of the strongest local maxima, by power and by power over the running median.
fn lines(power: &[f64]) -> Vec<usize> {
    let n = power.len();
    let peaks: Vec<usize> =
        (1..n.saturating_sub(1)).filter(|&i| power[i] > power[i - 1] && power[i] >= power[i + 1]).collect();
    let prominence: Vec<f64> = peaks
        .iter()
        .map(|&i| {
            let (a, b) = (i.saturating_sub(NEIGHBOURS / 2), (i + NEIGHBOURS / 2 + 1).min(n));
            let mut near = power[a..b].to_vec();
            near.sort_by(f64::total_cmp);
            power[i] / near[near.len() / 2].max(1e-300)
        })
        .collect();
    let best = |value: &dyn Fn(usize) -> f64| -> Vec<usize> {
        let mut order: Vec<usize> = (0..peaks.len()).collect();
        order.sort_by(|&a, &b| value(b).total_cmp(&value(a)).then(a.cmp(&b)));
        order.into_iter().take(LINES).map(|i| peaks[i]).collect()
    };
    let mut out = best(&|i| power[peaks[i]]);
    for i in best(&|i| prominence[i]) {
        if !out.contains(&i) {
            out.push(i);
        }
    }
    out
}

/// Power of a spectrum within so many lines of the angular frequency `w`.
fn power_near(frequency: &[f64], power: &[f64], w: f64, lines: f64) -> f64 {
    let step = frequency.get(1).copied().unwrap_or(f64::INFINITY);
    let near = |f: f64| (f - w / (2.0 * std::f64::consts::PI)).abs() <= lines * step;
    frequency.iter().zip(power).filter(|(f, _)| near(**f)).map(|(_, p)| p).sum()
}

/// Whether a good part of an input's power lies at the angular frequency `w`.
fn moves(frequency: &[f64], power: &[f64], w: f64) -> bool {
    power_near(frequency, power, w, 2.5) > DRIVEN * power.iter().sum::<f64>()
}

/// Whether it does and the input has a line there: most of its power thereabouts (a slow input has much power at
/// low frequencies, and no line).
fn drives(frequency: &[f64], power: &[f64], w: f64) -> bool {
    moves(frequency, power, w)
        && power_near(frequency, power, w, 2.5) > LINE * power_near(frequency, power, w, 10.0)
}

fn distinct(values: Vec<f64>) -> Vec<f64> {
    let mut out: Vec<f64> = Vec::new();
    for v in values {
        if v > 0.0 && v.is_finite() && !out.iter().any(|o| (o / v - 1.0).abs() < 1e-3) {
            out.push(v);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strong_and_prominent_lines_are_both_proposed() {
        // A steep continuum with a weak line far out: only its prominence shows it.
        let mut power: Vec<f64> =
            (0..400).map(|i| 1e6 / (1.0 + (i as f64).powi(3)) * (1.5 + (i as f64 * 2.3).sin())).collect();
        power[300] += 1.0;
        assert!(lines(&power).contains(&300));
        assert!(!lines(&power)[..LINES].contains(&300));
    }
    #[test]
    fn an_input_has_a_line_where_it_is_a_sine_and_none_where_it_is_slow() {
        use std::f64::consts::TAU;
        let frequency: Vec<f64> = (0..500).map(|i| f64::from(i) * 0.05).collect();
        // Noise through a lag of 0.3 Hz: a good part of its power lies around 0.2 Hz, in no line.
        let slow: Vec<f64> = frequency.iter().map(|f| 1.0 / (1.0 + (f / 0.3).powi(2))).collect();
        let here: f64 = slow[2..=6].iter().sum();
        assert!(here > 2.0 * DRIVEN * slow.iter().sum::<f64>());
        assert!(!drives(&frequency, &slow, TAU * 0.2));
        // The same with a sine of 0.5 Hz, as wide as a window makes it.
        let mut line = slow.clone();
        for (i, share) in [(9, 0.5), (10, 1.0), (11, 0.5)] {
            line[i] += 100.0 * share;
        }
        assert!(drives(&frequency, &line, TAU * 0.5));
        assert!(!drives(&frequency, &line, TAU * 3.0));
    }
}
