//! What recordings say over machines, where a table says which machine each is of.

use std::collections::{BTreeMap, BTreeSet};

use greybox_fleet::machines::{self, Estimate};
use greybox_fleet::{Effect, share};

use crate::contract::Interval;
use crate::summary::{Level, MachineEstimate, MachinesOver, RecordingResult, Run, ShareOver, SlopeOver};

/// What the table of recordings says of each, by the names of the recordings that it has.
pub(crate) type Runs<'a> = BTreeMap<&'a str, &'a Run>;

/// Of these recordings.
pub(crate) fn runs(recordings: &[RecordingResult]) -> Runs<'_> {
    recordings.iter().filter_map(|r| Some((r.recording.as_str(), r.run.as_ref()?))).collect()
}

/// The recordings by machine.
pub(crate) struct Fleet<'a> {
    runs: Runs<'a>,
    /// The machines, in the order of their names, and how many of their recordings were diagnosed.
    machines: BTreeMap<&'a str, usize>,
    /// Headers of the covariates.
    covariates: Vec<&'a str>,
}

impl<'a> Fleet<'a> {
    pub(crate) fn of(recordings: &'a [RecordingResult]) -> Fleet<'a> {
        let runs = runs(recordings);
        let mut machines = BTreeMap::new();
        let mut covariates: Vec<&str> = Vec::new();
        for run in runs.values() {
            *machines.entry(run.machine.as_str()).or_default() += 1;
            for covariate in run.covariates.keys() {
                if !covariates.contains(&covariate.as_str()) {
                    covariates.push(covariate);
                }
            }
        }
        Fleet { runs, machines, covariates }
    }

    /// The machines in which something is found that is found in these recordings; `None` without a table.
    pub(crate) fn share<'b>(&self, found_in: impl Iterator<Item = &'b str>) -> Option<ShareOver> {
        if self.machines.is_empty() {
            return None;
        }
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        let recordings: BTreeSet<&str> = found_in.collect();
        for run in recordings.iter().filter_map(|recording| self.runs.get(recording)) {
            *counts.entry(run.machine.as_str()).or_default() += 1;
        }
        let found: Vec<String> = counts
            .into_iter()
            .filter(|(machine, found)| self.machines.get(machine).is_some_and(|of| 2 * found >= *of))
            .map(|(machine, _)| machine.to_owned())
            .collect();
        let share = share(found.len(), self.machines.len());
        Some(ShareOver { found_in: found, of: share.of, ci95: share.ci95.into() })
    }

    /// The mixed model of estimates by recording.
    pub(crate) fn over(&self, estimates: &[(&str, Effect)]) -> Option<MachinesOver> {
        let names: Vec<&str> = self.machines.keys().copied().collect();
        let estimates: Vec<Estimate> = estimates
            .iter()
            .filter_map(|(recording, effect)| {
                let run = self.runs.get(recording)?;
                Some(Estimate {
                    machine: names.binary_search(&run.machine.as_str()).ok()?,
                    effect: *effect,
                    covariates: self
                        .covariates
                        .iter()
                        .map(|covariate| run.covariates.get(*covariate).copied().unwrap_or(f64::NAN))
                        .collect(),
                })
            })
            .collect();
        let found = machines::analyse(&estimates)?;
        let interval = |told: machines::Interval| -> Interval { told.ends().into() };
        Some(MachinesOver {
            value: found.mean.value,
            ci95: interval(found.mean),
            between: found.between,
            within: found.within,
            slopes: found
                .slopes
                .iter()
                .map(|slope| SlopeOver {
                    covariate: self.covariates[slope.covariate].to_owned(),
                    level: match slope.level {
                        machines::Level::Within => Level::Within,
                        machines::Level::Between => Level::Between,
                    },
                    value: slope.slope.value,
                    ci95: interval(slope.slope),
                    p_value: slope.p_value,
                    significant: slope.significant,
                })
                .collect(),
            machines: found
                .machines
                .iter()
                .map(|machine| MachineEstimate {
                    machine: names[machine.machine].to_owned(),
                    recordings: machine.recordings,
                    value: machine.value.value,
                    ci95: interval(machine.value),
                    differs: machine.differs,
                })
                .collect(),
        })
    }
}
