//! A number over many machines on the page of a summary.

use std::collections::BTreeMap;

use super::summary::{Forest, forest, labelled};
use crate::machines::Runs;
use crate::page::MechanismPlot;
use crate::sentence::recordings::probability;
use crate::summary::{Level, MachineEstimate, MachinesOver, Pooled, RecordingEstimate, SlopeOver};
use crate::{expression, format, svg};

pub(super) struct MachinesView {
    pub(super) value: String,
    pub(super) between: String,
    pub(super) within: String,
    pub(super) slopes: Vec<SlopeView>,
    /// Name, value and probability of each that differs.
    pub(super) different: Vec<[String; 3]>,
    pub(super) plot: Option<Forest>,
}

pub(super) struct SlopeView {
    pub(super) covariate: String,
    pub(super) level: &'static str,
    pub(super) value: String,
    pub(super) probability: String,
    pub(super) significant: bool,
    /// Drawn where the slope is taken for real.
    pub(super) plot: Option<String>,
}

impl MachinesView {
    /// Of the parameter called `name`; `None` where it has no model over the machines.
    pub(super) fn of(name: &str, pooled: &Pooled, runs: &Runs<'_>) -> Option<MachinesView> {
        let over = pooled.machines.as_ref()?;
        // Those that differ come first: a plot shows no more than its first rows.
        let (mut rows, others): (Vec<&MachineEstimate>, Vec<_>) =
            over.machines.iter().partition(|m| m.differs.is_some());
        let different = rows
            .iter()
            .map(|m| {
                let p = m.differs.map_or_else(String::new, probability);
                [m.machine.clone(), format::cell(m.value, Some(m.ci95)), p]
            })
            .collect();
        rows.extend(others);
        let estimate = |m: &&MachineEstimate| RecordingEstimate {
            recording: m.machine.clone(),
            value: m.value,
            ci95: Some(m.ci95),
        };
        let drawn = Pooled {
            value: over.value,
            ci95: Some(over.ci95),
            estimates: rows.iter().map(estimate).collect(),
            unit: pooled.unit.clone(),
            machines: None,
            ..*pooled
        };
        Some(MachinesView {
            value: format::cell(over.value, Some(over.ci95)),
            between: format::significant(over.between, 2),
            within: over.within.map_or_else(|| "–".to_owned(), |within| format::significant(within, 2)),
            slopes: over.slopes.iter().map(|slope| slope_view(name, pooled, over, slope, runs)).collect(),
            different,
            plot: forest(name, &drawn, "machine"),
        })
    }
}

fn slope_view(
    name: &str,
    pooled: &Pooled,
    over: &MachinesOver,
    slope: &SlopeOver,
    runs: &Runs<'_>,
) -> SlopeView {
    SlopeView {
        covariate: slope.covariate.clone(),
        level: match slope.level {
            Level::Within => "on one machine",
            Level::Between => "from machine to machine",
        },
        value: format::cell(slope.value, Some(slope.ci95)),
        probability: probability(slope.p_value),
        significant: slope.significant,
        plot: slope.significant.then(|| plot(name, pooled, over, slope, runs)).flatten(),
    }
}

/// The recordings' estimates over the covariate, the machines' own values taken out, or the machines' values over their
/// means of the covariate; and the slope.
fn plot(
    name: &str,
    pooled: &Pooled,
    over: &MachinesOver,
    slope: &SlopeOver,
    runs: &Runs<'_>,
) -> Option<String> {
    let at = |recording: &str| {
        let run = runs.get(recording)?;
        Some((run.machine.as_str(), *run.covariates.get(&slope.covariate)?))
    };
    let mut means: BTreeMap<&str, (f64, f64)> = BTreeMap::new();
    for (machine, x) in pooled.estimates.iter().filter_map(|e| at(&e.recording)) {
        let (sum, count) = means.entry(machine).or_default();
        *sum += x;
        *count += 1.0;
    }
    let mean = |machine: &str| means.get(machine).map(|(sum, count)| sum / count);
    let overall = means.values().map(|(sum, count)| sum / count).sum::<f64>() / means.len() as f64;
    let own: BTreeMap<&str, f64> = over.machines.iter().map(|m| (m.machine.as_str(), m.value)).collect();
    let points: Vec<[f64; 2]> = match slope.level {
        Level::Within => pooled
            .estimates
            .iter()
            .filter_map(|e| {
                let (machine, x) = at(&e.recording)?;
                Some([x - mean(machine)? + overall, e.value - own.get(machine)? + over.value])
            })
            .collect(),
        Level::Between => own.iter().filter_map(|(machine, value)| Some([mean(machine)?, *value])).collect(),
    };
    let (low, high) =
        points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), p| (l.min(p[0]), h.max(p[0])));
    let line = |x: f64| [x, over.value + slope.value * (x - overall)];
    let drawn = MechanismPlot {
        mechanism: None,
        title: String::new(),
        x_label: slope.covariate.clone(),
        y_label: labelled(name, &pooled.unit),
        points,
        curve: vec![line(low), line(high)],
    };
    let alt = format!("{} over {}, and the fitted slope", expression::text(name), slope.covariate);
    svg::law_plot(&drawn, &alt).map(|plot| plot.svg)
}
