//! What a parameter is over many machines, in plain language.

use crate::contract::Interval;
use crate::summary::{Level, MachinesOver, Method, Pooled, ShareOver, SlopeOver};
use crate::{expression, format};

use super::joined;
use super::recordings::probability;

/// Most machines that a sentence names.
const NAMED: usize = 5;

/// `in 9 of 10 machines (62 % to 99 % of such machines)`.
pub fn share(over: &ShareOver) -> String {
    format!(
        "in {} of {} machines ({} to {} of such machines)",
        over.found_in.len(),
        over.of,
        format::percent_short(over.ci95.low),
        format::percent_short(over.ci95.high)
    )
}

/// What is to be told of a parameter over machines, in sentences: how it scatters, what it depends on, which machines differ.
pub fn sentences(name: &str, pooled: &Pooled) -> Vec<String> {
    let Some(over) = &pooled.machines else { return Vec::new() };
    let name = expression::text(name);
    let mut out = Vec::new();
    if pooled.method == Method::RandomEffects {
        out.push(scatter(&name, pooled, over));
    }
    out.extend(over.slopes.iter().filter(|slope| slope.significant).map(|slope| told(&name, pooled, slope)));
    out.extend(different(&name, pooled, over));
    out
}

/// A number with the parameter's unit.
fn quantity(pooled: &Pooled, value: f64, ci95: Option<Interval>) -> String {
    let unit = format::unit(&pooled.unit);
    let space = if unit.is_empty() { "" } else { " " };
    format!("{}{space}{unit}", format::with_interval(value, ci95))
}

fn scatter(name: &str, pooled: &Pooled, over: &MachinesOver) -> String {
    let size = |value: f64| format::with_unit(&format::significant(value, 2), &pooled.unit);
    let within = match over.within {
        Some(within) if within > 0.0 => {
            format!(" and by {} from recording to recording of one", size(within))
        }
        _ => String::new(),
    };
    format!(
        "Over the machines, {name} = {}; it differs by {} from machine to machine{within} (standard deviation).",
        quantity(pooled, over.value, Some(over.ci95)),
        size(over.between)
    )
}

/// `fc falls by 0.0100 ± 0.0020 N for each degC of temperature, on one machine (p < 0.001).`
fn told(name: &str, pooled: &Pooled, slope: &SlopeOver) -> String {
    let (covariate, unit) = match slope.covariate.split_once(" [") {
        Some((covariate, unit)) => (covariate, unit.trim_end_matches(']')),
        None => (slope.covariate.as_str(), ""),
    };
    let (verb, sign) = if slope.value < 0.0 { ("falls", -1.0) } else { ("rises", 1.0) };
    let (ends, size) = ([sign * slope.ci95.low, sign * slope.ci95.high], sign * slope.value);
    let ci95 = Interval::new(ends[0].min(ends[1]), ends[0].max(ends[1]));
    let each = match (covariate, unit) {
        ("date", _) => "a year".to_owned(),
        (_, "") => format!("for each unit of {covariate}"),
        _ => format!("for each {} of {covariate}", format::unit(unit)),
    };
    let level = match slope.level {
        Level::Within => "on one machine",
        Level::Between => "from machine to machine",
    };
    format!(
        "{name} {verb} by {} {each}, {level} ({}).",
        quantity(pooled, size, Some(ci95)),
        probability(slope.p_value)
    )
}

fn different(name: &str, pooled: &Pooled, over: &MachinesOver) -> Option<String> {
    let mut different: Vec<_> = over.machines.iter().filter(|m| m.differs.is_some()).collect();
    different.sort_by(|a, b| a.differs.partial_cmp(&b.differs).unwrap_or(std::cmp::Ordering::Equal));
    let mut named: Vec<String> = different
        .iter()
        .take(NAMED)
        .map(|m| format!("{} ({})", m.machine, quantity(pooled, m.value, Some(m.ci95))))
        .collect();
    match different.len().saturating_sub(NAMED) {
        0 => {}
        1 => named.push("one more".to_owned()),
        n => named.push(format!("{n} more")),
    }
    let verb = if different.len() == 1 { "differs" } else { "differ" };
    (!named.is_empty()).then(|| {
        format!(
            "{} {verb} from the other machines in {name} ({} there).",
            joined(&named, "and"),
            quantity(pooled, over.value, Some(over.ci95))
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::summary::MachineEstimate;

    fn pooled() -> Pooled {
        let interval = |value: f64, half: f64| Interval::new(value - half, value + half);
        let machine = |name: &str, value: f64, differs: Option<f64>| MachineEstimate {
            machine: name.to_owned(),
            recordings: 3,
            value,
            ci95: interval(value, 0.03),
            differs,
        };
        let slope = |covariate: &str, level: Level, value: f64, significant: bool| SlopeOver {
            covariate: covariate.to_owned(),
            level,
            value,
            ci95: interval(value, 0.002),
            p_value: if significant { 1e-5 } else { 0.4 },
            significant,
        };
        Pooled {
            value: 0.5,
            ci95: Some(interval(0.5, 0.01)),
            unit: "N".to_owned(),
            method: Method::RandomEffects,
            heterogeneity: None,
            estimates: vec![],
            machines: Some(MachinesOver {
                value: 0.51,
                ci95: interval(0.51, 0.02),
                between: 0.049,
                within: Some(0.012),
                slopes: vec![
                    slope("temperature [degC]", Level::Within, -0.01, true),
                    slope("date [a]", Level::Within, 0.02, true),
                    slope("batch", Level::Between, 0.03, true),
                    slope("humidity [%]", Level::Within, 0.001, false),
                ],
                machines: vec![
                    machine("A-01", 0.5, None),
                    machine("A-07", 0.82, Some(1e-6)),
                    machine("A-09", 0.2, Some(1e-8)),
                ],
            }),
        }
    }

    #[test]
    fn what_is_found_is_told() {
        assert_eq!(
            sentences("fc", &pooled()),
            [
                "Over the machines, fc = 0.510 ± 0.020 N; it differs by 0.049 N from machine to machine and by 0.012 N \
                 from recording to recording of one (standard deviation).",
                "fc falls by 0.0100 ± 0.0020 N for each degC of temperature, on one machine (p < 0.001).",
                "fc rises by 0.0200 ± 0.0020 N a year, on one machine (p < 0.001).",
                "fc rises by 0.0300 ± 0.0020 N for each unit of batch, from machine to machine (p < 0.001).",
                "A-09 (0.20 ± 0.03 N) and A-07 (0.82 ± 0.03 N) differ from the other machines in fc (0.510 ± 0.020 N there).",
            ]
        );
        let alone = Pooled { machines: None, ..pooled() };
        assert!(sentences("fc", &alone).is_empty());
    }

    #[test]
    fn many_machines_are_counted() {
        let mut pooled = pooled();
        let over = pooled.machines.as_mut().unwrap();
        let one = over.machines[1].clone();
        over.machines.extend((0..5).map(|k| MachineEstimate { machine: format!("B-{k}"), ..one.clone() }));
        over.slopes.clear();
        let told = sentences("fc", &pooled).pop().unwrap();
        assert!(told.contains("B-2 (0.82 ± 0.03 N) and 2 more differ"), "{told}");
        assert!(
            share(&ShareOver { found_in: vec!["a".into()], of: 2, ci95: Interval::new(0.1, 0.9) })
                .starts_with("in 1 of 2 machines (10 % to 90 %")
        );
    }
}
