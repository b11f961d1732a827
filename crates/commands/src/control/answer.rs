//! What was designed, for machines and in words.

use std::fmt::Write as _;

use greybox_control::{
    Integral, Margins, Method, Metrics, ObserverMethod, OutputFeedback, Plant, Pole, Run, Tracking,
    TrackingError, observer,
};
use greybox_report::{ControlPage, format, sentence};
use serde_json::{Value, json};

use super::designed::Designed;

pub(super) fn observer_in_words(output: &OutputFeedback) -> String {
    match output.method() {
        ObserverMethod::Kalman { disturbance } => format!(
            "Kalman filter, disturbance of {} of the command in a second",
            format::number(*disturbance)
        ),
        ObserverMethod::Eso { bandwidth } => {
            format!("Extended-state observer, bandwidth {} 1/s", format::number(*bandwidth))
        }
    }
}

pub(super) fn report(page: &ControlPage, designed: &Designed<'_>) -> Value {
    let Designed { controller, output, run, family, .. } = *designed;
    let plant = controller.plant();
    let (low, high) = controller.limits();
    let limit = |v: f64| if v.is_finite() { json!(v) } else { Value::Null };
    let margins = |m: &Margins| {
        json!({
            "gain": limit(m.gain), "lower_gain": m.lower_gain, "phase": m.phase, "delay": limit(m.delay),
            "sensitivity": m.sensitivity,
        })
    };
    let full = controller.margins_late(plant, designed.delay);
    let observed = output.map(|o| o.margins_late(controller, plant, designed.delay));
    let observed = |k: usize| observed.as_ref()?.get(k)?.as_ref();
    let checks: Vec<Value> = controller
        .checks()
        .iter()
        .enumerate()
        .map(|(k, c)| {
            let poles = |poles: &[Pole]| poles.iter().map(|p| [p.re, p.im]).collect::<Vec<_>>();
            json!({
                "set_point": c.set_point, "state": c.equilibrium.state, "command": c.equilibrium.input,
                "poles": poles(&c.poles), "held_poles": poles(&c.held_poles), "spectral_radius": c.spectral_radius,
                "stuck_poles": poles(&c.stuck_poles), "margins": full.get(k).and_then(Option::as_ref).map(margins),
                "with_observer": output.and_then(|o| o.checks().get(k)).map(|c| json!({
                    "spectral_radius": c.spectral_radius, "margins": observed(k).map(margins),
                })),
            })
        })
        .collect();
    let spread = |s: &greybox_control::Spread| json!({ "median": limit(s.median), "worst": limit(s.worst) });
    json!({
        "greybox": page.producer,
        "model": page.model.file,
        "verdict": page.verdict.name(),
        "summary": sentence::control::summary(page),
        "method": controller.method().name(),
        "input": plant.input_name(),
        "states": plant.state_names(),
        "tracked": plant.state_names().get(controller.tracked()),
        "dt": controller.dt(),
        "limits": [limit(low), limit(high)],
        "bounded": matches!(controller.method(), Method::Hjb { bounded: true, .. }),
        "gains": controller.gains(),
        "law": match output {
            Some(output) => vec![output.law().to_string()],
            None => controller.law().iter().map(ToString::to_string).collect(),
        },
        "reads_derivatives": controller.trajectories(),
        "delay": page.delay,
        "input_delay": plant.input_delay(),
        "observer": output.map(|o| observer_report(plant, o)),
        "checks": checks,
        "left_out": plant.dropped().iter().map(|d| json!({
            "equation": d.equation, "term": d.term.to_string(),
        })).collect::<Vec<_>>(),
        "closed_loop": {
            "diverged": run.diverged.is_some(),
            "held_command": designed.held,
            "set_points": run.metrics.iter().map(metrics).collect::<Vec<_>>(),
            "tracking": run.tracking.as_ref().map(tracking),
        },
        "family": family.map(|f| json!({
            "members": f.members, "diverged": f.diverged, "settled": f.settled,
            "settling": spread(&f.settling), "overshoot": spread(&f.overshoot),
            "final_error": spread(&f.final_error),
            "rms_error": f.tracking.map(|t| spread(&t.rms_error)),
            "largest_error": f.tracking.map(|t| spread(&t.largest_error)), "peak_to_peak": spread(&f.peak_to_peak),
            "largest_command": spread(&f.largest_command), "effort": spread(&f.effort),
            "unstable": f.unstable,
            "margins": f.margins.map(|m| json!({
                "gain": spread(&m.gain), "lower_gain": spread(&m.lower_gain), "phase": spread(&m.phase),
                "delay": spread(&m.delay), "sensitivity": spread(&m.sensitivity),
            })),
        })),
    })
}

fn observer_report(plant: &Plant, output: &OutputFeedback) -> Value {
    let names = plant.state_names();
    let sensors = output.observer().measured().iter().zip(output.sensors());
    let (kind, setting) = match output.method() {
        ObserverMethod::Kalman { disturbance } => ("kalman", json!({ "disturbance": disturbance })),
        ObserverMethod::Eso { bandwidth } => ("eso", json!({ "bandwidth": bandwidth })),
    };
    let (gain, start) = match output.observer().form() {
        observer::Form::Kalman { gain, start } => {
            let command = start.point.last();
            (
                json!(gain),
                json!({
                    "state": start.point[..plant.order()], "command": command, "matrix": start.matrix,
                }),
            )
        }
        observer::Form::Eso(_) => (Value::Null, Value::Null),
    };
    json!({
        "kind": kind, "setting": setting, "integral": output.integral() != Integral::Off, "gain": gain,
        "start": start,
        "rest": output.rest().map(|rest| json!({
            "time": rest.time, "step": rest.step, "velocity": rest.velocity(), "integral_time": rest.integral_time,
        })),
        "sensors": sensors.map(|(&i, s)| json!({
            "state": names[i], "noise": s.noise, "resolution": s.resolution,
        })).collect::<Vec<_>>(),
    })
}

fn tracking(t: &Tracking) -> Value {
    let error = |e: &TrackingError| json!({ "rms": e.rms, "largest": e.largest });
    json!({
        "span": t.span, "error": error(&t.error), "later_error": error(&t.later_error),
        "largest_command": t.largest_command, "saturated": t.saturated, "effort": t.effort,
    })
}

fn metrics(m: &Metrics) -> Value {
    json!({
        "set_point": m.set_point, "settling": m.settling, "overshoot": m.overshoot,
        "final_error": m.final_error, "peak_to_peak": m.peak_to_peak, "rms_error": m.rms_error, "largest_command": m.largest_command,
        "saturated": m.saturated, "effort": m.effort,
    })
}

/// The worst margins over the set points, of the loop as it is fed back, with its delay.
fn worst_margins(designed: &Designed<'_>) -> Option<Margins> {
    let Designed { controller, output, delay, .. } = *designed;
    let all = match output {
        Some(output) => output.margins_late(controller, controller.plant(), delay),
        None => controller.margins_late(controller.plant(), delay),
    };
    all.into_iter().flatten().reduce(Margins::worse)
}

fn tracking_in_words(run: &Run, t: &Tracking) -> String {
    format!(
        "along the trajectory of {} s: error {} RMS, {} at most after the first quarter of the time ({} at most over all), command up to \
         {}",
        format::number(run.t.last().copied().unwrap_or_default()),
        format::number(t.later_error.rms),
        format::number(t.later_error.largest),
        format::number(t.error.largest),
        format::number(t.largest_command),
    )
}

fn margins_in_words(m: &Margins) -> String {
    format!(
        "gain × {} to {}, phase {}°, delay {} s",
        format::number(m.lower_gain),
        format::number(m.gain),
        format::number(m.phase.to_degrees()),
        format::number(m.delay),
    )
}

pub(super) fn in_words(page: &ControlPage, designed: &Designed<'_>) -> String {
    let Designed { file, controller, output, run, family, .. } = *designed;
    let plant = controller.plant();
    let tracked = plant.state_names().get(controller.tracked()).cloned().unwrap_or_default();
    let mut text = format!(
        "{} of {} for {tracked}, commanded by {} every {} s\n",
        match controller.method() {
            Method::Lqr => "Linear-quadratic regulator",
            Method::Hjb { bounded: false, .. } => "Optimal law",
            Method::Hjb { bounded: true, .. } => "Optimal law, its limits in the cost,",
            Method::Smc { .. } => "Sliding-mode law",
        },
        file,
        plant.input_name(),
        format::number(controller.dt()),
    );
    for (name, gain) in plant.state_names().iter().zip(controller.gains()) {
        let _ = writeln!(text, "  gain of {name}: {}", format::number(*gain));
    }
    if let Some(output) = output {
        let sensors = output.observer().measured().iter().zip(output.sensors()).map(|(&i, s)| {
            let name = plant.state_names().get(i).cloned().unwrap_or_default();
            match (s.noise, s.resolution) {
                (noise, 0.0) => format!("{name} (noise {})", format::number(noise)),
                (0.0, resolution) => format!("{name} (in steps of {})", format::number(resolution)),
                (noise, resolution) => {
                    format!(
                        "{name} (noise {}, in steps of {})",
                        format::number(noise),
                        format::number(resolution)
                    )
                }
            }
        });
        let sensors: Vec<String> = sensors.collect();
        if plant.input_delay() > 0.0 {
            let _ = writeln!(
                text,
                "  predicts over the delay of the command, {} s",
                format::number(plant.input_delay())
            );
        }
        let integral = match output.integral() {
            Integral::Disturbance => "",
            Integral::AtRest { .. } => "; integral action at rest",
            Integral::Off => "; no integral action",
        };
        let _ = writeln!(text, "  {}; measured: {}{integral}", observer_in_words(output), sensors.join(", "));
    }
    match worst_margins(designed) {
        Some(Margins::NONE) => {
            let _ = writeln!(text, "  margins: none, the loop is unstable with the stated delay");
        }
        Some(m) => {
            let _ = writeln!(text, "  margins: {}", margins_in_words(&m));
        }
        None => {}
    }
    if let Some(warning) = sentence::control::hunts(page) {
        let _ = writeln!(text, "  {warning}");
    }
    for dropped in plant.dropped() {
        let _ = writeln!(text, "  left out of {}: {}", dropped.equation, dropped.term);
    }
    for m in run.metrics.iter().skip(1) {
        let settling =
            m.settling.map_or("does not settle".into(), |s| format!("settles in {} s", format::number(s)));
        let _ = writeln!(
            text,
            "  to {}: {settling}, overshoot {}, ends {} off (peak to peak {}), command up to {}",
            format::number(m.set_point),
            format::percent(m.overshoot),
            format::number(m.final_error.abs()),
            format::number(m.peak_to_peak),
            format::number(m.largest_command),
        );
    }
    if let Some(t) = &run.tracking {
        let _ = writeln!(text, "  {}", tracking_in_words(run, t));
    }
    if let Some(at) = run.diverged {
        let t = run.t.get(at).copied().unwrap_or_default();
        let _ =
            writeln!(text, "  warning: the simulated loop leaves every bound after {} s", format::number(t));
    }
    if let Some(f) = family {
        let _ = writeln!(
            text,
            "  on {} perturbed plants: {} {}, {} diverge",
            f.members,
            f.settled,
            if f.tracking.is_some() { "track" } else { "settle" },
            f.diverged
        );
        match f.margins {
            Some(_) if f.unstable > 0 => {
                let _ = writeln!(text, "  linearised, {} of them are unstable at a set point", f.unstable);
            }
            Some(m) => {
                let _ = writeln!(text, "  their worst margins: {}", margins_in_words(&m.worst()));
            }
            None => {}
        }
    }
    text
}
