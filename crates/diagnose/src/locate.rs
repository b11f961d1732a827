//! Where a mechanism acts: instants, region of the state space, frequency band.
//!
//! The accepted law is evaluated along the states *simulated* by the improved model. A law with a
//! threshold (an end stop, a saturation) acts where the threshold says. Any other is located where its
//! force changes beyond what the linear terms of the model follow: the windows are the runs where the
//! deviation of the force from its regression on \[1, d, d', u\] is large (a friction force: around the
//! reversals of the motion), the region is the interval of the variable that holds 90 % of it.

use greybox_calibrate::{Setup, qr};
use greybox_model::Expr;

use crate::candidate::Instance;
use crate::library::{Mechanism, On};
use crate::place::Place;
use crate::trajectory::TrajectoryEval;

/// Location of a mechanism.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Location {
    /// Names of the equations.
    pub equations: Vec<String>,
    /// Per recording: (file, windows in s).
    pub windows: Vec<(String, Vec<(f64, f64)>)>,
    /// Expression of the model and its interval.
    pub region: Vec<(String, Option<f64>, Option<f64>)>,
    /// Frequency band of the mechanism's force, Hz.
    pub band: Option<(f64, f64)>,
}

/// Most windows listed per recording.
const MOST_WINDOWS: usize = 200;

/// Locates an instance along simulated states.
pub fn locate(
    setup: &Setup,
    along: &TrajectoryEval<'_>,
    mechanism: &Mechanism,
    instance: &Instance,
) -> Location {
    let candidate = &instance.candidate;
    let names: Vec<String> = mechanism.parameters().map(str::to_string).collect();
    let rename = |n: &str| {
        names.iter().position(|p| p == n).map_or_else(|| n.to_string(), |i| instance.names[i].clone())
    };
    let mut location = Location { equations: candidate.place.equations(&setup.model), ..Location::default() };
    // Bounds may use the RMS of the motion's rate, for laws that show around reversals.
    let rate = match &candidate.place {
        Place::Motion(m) => {
            m.rate.as_ref().and_then(|e| along.eval(std::slice::from_ref(e), &[])?.pop()).map(|s| {
                let n = s.iter().map(Vec::len).sum::<usize>().max(1) as f64;
                (s.iter().flatten().map(|v| v * v).sum::<f64>() / n).sqrt()
            })
        }
        _ => None,
    };
    let value = |e: &Expr| {
        let e = candidate.translate(&setup.model, e, &rename);
        e.eval(&|n, _| match n {
            "rms_rate" => rate,
            _ => setup.model.parameter(n).map(|i| setup.model.parameters[i].value),
        })
    };
    let active: Vec<Vec<bool>>;
    let force = force(setup, along, mechanism, instance);
    if let Some(region) = &mechanism.region {
        let variable = candidate.translate(&setup.model, &region.variable, &rename).simplify();
        let low = region.low.as_ref().and_then(&value);
        let high = region.high.as_ref().and_then(&value);
        let Some(series) = along.eval(std::slice::from_ref(&variable), &[]).and_then(|mut s| s.pop()) else {
            return location;
        };
        active = series
            .iter()
            .map(|s| s.iter().map(|v| low.is_none_or(|l| *v >= l) && high.is_none_or(|h| *v <= h)).collect())
            .collect();
        location.region.push((variable.to_string(), low, high));
    } else {
        let Some(force) = &force else { return location };
        let mut regressors = vec![Expr::Num(1.0)];
        let mut variables: Vec<Expr> = Vec::new();
        if let Place::Motion(m) = &candidate.place {
            // The law's own variable first.
            for (e, primes) in [(&m.rate, 1u8), (&m.position, 0)] {
                if let Some(e) = e {
                    regressors.push(e.clone());
                    if mechanism.law.contains("d", primes) {
                        variables.push(e.clone());
                    }
                }
            }
        }
        for input in &setup.model.inputs {
            regressors.push(Expr::var(&input.name));
        }
        let Some(columns) = along.eval(&regressors, &[]) else { return location };
        let deviation = deviation(force, &columns);
        let own: Vec<Option<Vec<Vec<f64>>>> = variables
            .iter()
            .map(|v| along.eval(std::slice::from_ref(v), &[]).and_then(|mut s| s.pop()))
            .collect();
        let power: f64 = deviation.iter().flatten().map(|v| v * v).sum();
        let all: f64 = force.iter().flatten().map(|v| v * v).sum();
        if power <= 1e-9 * all {
            // The linear terms follow it entirely (an offset, a linear spring): it acts always.
            active = force.iter().map(|f| vec![true; f.len()]).collect();
            for (variable, series) in variables.iter().zip(&own) {
                if let Some(series) = series {
                    let (lo, hi) = extent(series);
                    location.region.push((variable.to_string(), Some(lo), Some(hi)));
                }
            }
        } else {
            active = windows(&deviation);
            for (variable, series) in variables.iter().zip(&own) {
                if let Some(series) = series
                    && let Some((lo, hi)) = shortest(series, &deviation)
                {
                    location.region.push((variable.to_string(), Some(lo), Some(hi)));
                }
            }
        }
    }
    for (r, name) in setup.data.recordings.iter().enumerate() {
        let mut list = Vec::new();
        for (piece, active) in setup.data.pieces.iter().zip(&active) {
            if piece.recording == r {
                list.extend(runs(active, piece.start, piece.dt));
            }
        }
        list.truncate(MOST_WINDOWS);
        location.windows.push((name.clone(), list));
    }
    if let Some(force) = &force {
        location.band = band(setup, force);
    }
    location
}

/// The mechanism's force (or its change of an input or measurement) per piece.
pub fn force(
    setup: &Setup,
    along: &TrajectoryEval<'_>,
    mechanism: &Mechanism,
    instance: &Instance,
) -> Option<Vec<Vec<f64>>> {
    let e = match (mechanism.on, &instance.candidate.place) {
        (On::Input, Place::Input(i)) => instance.expression.clone() - Expr::var(&setup.model.inputs[*i].name),
        _ => instance.expression.clone(),
    };
    along.eval(&[e], &[])?.pop()
}

/// `force` less its least-squares regression on the columns.
fn deviation(force: &[Vec<f64>], columns: &[Vec<Vec<f64>>]) -> Vec<Vec<f64>> {
    let n: usize = force.iter().map(Vec::len).sum();
    let k = columns.len();
    let mut q: Vec<f64> = Vec::with_capacity(n * k);
    for c in columns {
        for piece in c {
            q.extend(piece);
        }
    }
    qr::orthonormalise(&mut q, n, k);
    let mut f: Vec<f64> = force.concat();
    qr::project_off(&q, n, &mut f);
    let mut out = Vec::new();
    let mut at = 0;
    for piece in force {
        out.push(f[at..at + piece.len()].to_vec());
        at += piece.len();
    }
    out
}

/// Runs where the smoothed power of the deviation is large: hysteresis between 30 % and 10 % of its 99 %
/// quantile.
fn windows(deviation: &[Vec<f64>]) -> Vec<Vec<bool>> {
    let smooth: Vec<Vec<f64>> = deviation
        .iter()
        .map(|d| {
            (0..d.len())
                .map(|k| {
                    let (a, b) = (k.saturating_sub(2), (k + 3).min(d.len()));
                    d[a..b].iter().map(|v| v * v).sum::<f64>() / (b - a) as f64
                })
                .collect()
        })
        .collect();
    let mut all: Vec<f64> = smooth.iter().flatten().copied().collect();
    all.sort_by(f64::total_cmp);
    let top = all.get((all.len().saturating_sub(1)) * 99 / 100).copied().unwrap_or(0.0);
    smooth
        .iter()
        .map(|s| {
            let mut on = false;
            s.iter()
                .map(|v| {
                    on = if on { *v > 0.1 * top } else { *v > 0.3 * top };
                    on
                })
                .collect()
        })
        .collect()
}

/// The shortest interval of `variable` that holds 90 % of the deviation's power.
fn shortest(variable: &[Vec<f64>], deviation: &[Vec<f64>]) -> Option<(f64, f64)> {
    let mut pairs: Vec<(f64, f64)> = variable
        .iter()
        .flatten()
        .zip(deviation.iter().flatten())
        .filter(|(v, _)| v.is_finite())
        .map(|(v, d)| (*v, d * d))
        .collect();
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = pairs.iter().map(|p| p.1).sum();
    let (mut best, mut sum, mut i) = (None, 0.0, 0);
    for j in 0..pairs.len() {
        sum += pairs[j].1;
        while sum - pairs[i].1 >= 0.9 * total && i < j {
            sum -= pairs[i].1;
            i += 1;
        }
        if sum >= 0.9 * total {
            let width = pairs[j].0 - pairs[i].0;
            if best.is_none_or(|(_, _, w)| width < w) {
                best = Some((pairs[i].0, pairs[j].0, width));
            }
        }
    }
    best.map(|(a, b, _)| (a, b))
}

/// Least and largest finite value.
pub(crate) fn extent(series: &[Vec<f64>]) -> (f64, f64) {
    series
        .iter()
        .flatten()
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(*v), hi.max(*v)))
}

/// Runs of active samples as time windows; gaps of up to three samples are closed.
fn runs(active: &[bool], start: f64, dt: f64) -> Vec<(f64, f64)> {
    let mut out: Vec<(usize, usize)> = Vec::new();
    for (k, on) in active.iter().enumerate() {
        if *on {
            match out.last_mut() {
                Some((_, b)) if k - *b <= 4 => *b = k,
                _ => out.push((k, k)),
            }
        }
    }
    let time = |k: usize| time_of(start, dt, k);
    out.into_iter().map(|(a, b)| (time(a), time(b + 1))).collect()
}

/// Time of a sample, s, to the microsecond.
pub(crate) fn time_of(start: f64, dt: f64, sample: usize) -> f64 {
    ((start + sample as f64 * dt) * 1e6).round() / 1e6
}

/// Band that holds the middle 90 % of the force's power (mean removed).
fn band(setup: &Setup, force: &[Vec<f64>]) -> Option<(f64, f64)> {
    let (piece, f) = setup.data.pieces.iter().zip(force).max_by_key(|(p, _)| p.len)?;
    let (freq, power) = spectrum(f, piece.dt);
    let total: f64 = power.iter().sum();
    if total <= 0.0 {
        return None;
    }
    let at = |share: f64| {
        let mut sum = 0.0;
        for (f, p) in freq.iter().zip(&power) {
            sum += p;
            if sum >= share * total {
                return *f;
            }
        }
        freq.last().copied().unwrap_or(0.0)
    };
    Some((at(0.05), at(0.95)))
}

/// Power spectral density (Hann window, mean removed, Welch segments), one-sided, per Hz.
pub fn spectrum(x: &[f64], dt: f64) -> (Vec<f64>, Vec<f64>) {
    let n = x.len();
    if n < 16 {
        return (Vec::new(), Vec::new());
    }
    // Long enough to resolve, short enough to average.
    let length = n.min(8192.max(n / 8)).max(16);
    let step = (length / 2).max(1);
    let mean = x.iter().sum::<f64>() / n as f64;
    let window: Vec<f64> = (0..length)
        .map(|k| 0.5 - 0.5 * (2.0 * std::f64::consts::PI * (k as f64 + 0.5) / length as f64).cos())
        .collect();
    let norm: f64 = window.iter().map(|w| w * w).sum::<f64>() / dt;
    let fft = rustfft::FftPlanner::<f64>::new().plan_fft_forward(length);
    let mut power = vec![0.0; length / 2 + 1];
    let mut count = 0.0;
    let mut at = 0;
    while at + length <= n {
        let mut buffer: Vec<rustfft::num_complex::Complex<f64>> = x[at..at + length]
            .iter()
            .zip(&window)
            .map(|(v, w)| rustfft::num_complex::Complex::new((v - mean) * w, 0.0))
            .collect();
        fft.process(&mut buffer);
        for (p, c) in power.iter_mut().zip(&buffer) {
            *p += 2.0 * c.norm_sqr() / norm;
        }
        count += 1.0;
        at += step;
    }
    let freq = (0..power.len()).map(|k| k as f64 / (length as f64 * dt)).collect();
    power.iter_mut().for_each(|p| *p /= count);
    (freq, power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_close_small_gaps() {
        let a = [false, true, true, false, false, true, false, false, false, false, false, true];
        assert_eq!(runs(&a, 1.0, 0.5), vec![(1.5, 4.0), (6.5, 7.0)]);
    }

    #[test]
    fn spectrum_holds_the_power_of_a_sine_at_its_frequency() {
        let dt = 0.01;
        let x: Vec<f64> =
            (0..2000).map(|k| 3.0 * (2.0 * std::f64::consts::PI * 7.0 * k as f64 * dt).sin()).collect();
        let (f, p) = spectrum(&x, dt);
        let peak = (0..p.len()).max_by(|a, b| p[*a].total_cmp(&p[*b])).unwrap();
        assert!((f[peak] - 7.0).abs() < 0.06);
        let power: f64 = p.iter().sum::<f64>() * f[1];
        assert!((power - 4.5).abs() < 0.05, "{power}");
    }

    #[test]
    fn the_shortest_interval_holds_the_bulk() {
        let v: Vec<f64> = (0..100).map(|k| k as f64).collect();
        let d: Vec<f64> = (0..100).map(|k| if (40..50).contains(&k) { 1.0 } else { 0.01 }).collect();
        let (lo, hi) = shortest(&[v], &[d]).unwrap();
        assert!(lo >= 40.0 && hi <= 49.0, "{lo} {hi}");
    }
}
