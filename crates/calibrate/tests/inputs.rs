//! Inputs whose derivative is needed, constant inputs, recordings that differ in a known constant, and what an input does in
//! rows that were left out.

use std::sync::Arc;

use crate::common::{fit, force, normal};
use greybox_calibrate::{Data, Setup, free_parameters};
use greybox_model::{Hold, Model};
use greybox_recording::{Channel, Recording, parse_csv};

const DT: f64 = 0.01;

fn recording(name: &str, columns: &[(&str, Option<&str>, &[f64])]) -> Recording {
    let channels = columns.iter().map(|(name, unit, values)| Channel {
        name: (*name).to_owned(),
        unit: unit.map(str::to_owned),
        values: values.to_vec(),
    });
    let n = columns[0].2.len();
    let time = (0..n).map(|k| k as f64 * DT).collect();
    Recording::from_columns(name, time, channels.collect()).unwrap()
}

fn laid_out(text: &str, recordings: &[Recording]) -> Setup {
    let model = Model::from_toml(text, "m.toml").unwrap();
    let data = Arc::new(Data::new(&model, recordings).unwrap());
    Setup::new(&model, data, free_parameters(&model)).unwrap()
}

/// Parameters fitted from the model's own, by name.
fn fitted(setup: &Setup) -> Vec<(String, f64)> {
    let found = fit(setup, &setup.level(6), &setup.data.sigma);
    setup.model.parameters.iter().map(|p| p.name.clone()).zip(found.point.parameters).collect()
}

fn of(found: &[(String, f64)], name: &str) -> f64 {
    found.iter().find(|(n, _)| n == name).unwrap().1
}

/// x'' = force(t, x, x') in small steps of Heun's method from rest, sampled.
fn simulated(n: usize, force: impl Fn(usize, f64, f64, f64) -> f64) -> Vec<f64> {
    let (fine, mut x, mut v) = (40, 0.0, 0.0);
    let h = DT / fine as f64;
    let mut y = Vec::with_capacity(n);
    for k in 0..n {
        y.push(x);
        for i in 0..fine {
            let w = |i: usize| i as f64 / fine as f64;
            let a = force(k, w(i), x, v);
            let b = force(k, w(i + 1), x + h * v, v + h * a);
            x += h * (v + 0.5 * h * a);
            v += 0.5 * h * (a + b);
        }
    }
    y
}

/// Value and slope of the straight line from sample k to the next.
fn line(u: &[f64], k: usize, w: f64) -> (f64, f64) {
    let step = u[(k + 1).min(u.len() - 1)] - u[k];
    (u[k] + w * step, step / DT)
}

const BASE: &str = r#"
[inputs]
u  = { unit = "m" }
du = { unit = "m/s", channel = "u'" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 2.0, unit = "kg", fixed = true }
b = { value = 2.0, unit = "N s/m" }
k = { value = 60.0, unit = "N/m" }
[equations]
mass = "m*x'' + b*(x' - du) + k*(x - u) = 0"
"#;

/// A mass on a base that moves: b = 3, k = 80.
fn on_a_base(n: usize) -> (Vec<f64>, Vec<f64>) {
    let u = force(3, n, DT, 3.0, 0.02);
    let y = simulated(n, |k, w, x, v| {
        let (u, du) = line(&u, k, w);
        (3.0 * (du - v) + 80.0 * (u - x)) / 2.0
    });
    (u, y)
}

#[test]
fn the_derivative_of_a_channel_drives_a_model() {
    let n = 2000;
    let (u, mut y) = on_a_base(n);
    for (y, e) in y.iter_mut().zip(normal(5, n)) {
        *y += 1e-5 * e;
    }
    // In millimetres: the derivative is converted like its channel.
    let mm = |v: &[f64]| v.iter().map(|v| 1e3 * v).collect::<Vec<f64>>();
    let run = recording("run.csv", &[("u", Some("mm"), &mm(&u)), ("x", Some("mm"), &mm(&y))]);
    let setup = laid_out(BASE, &[run]);
    assert_eq!(setup.holds, [Hold::Linear, Hold::Zero]);
    let found = fitted(&setup);
    assert!((of(&found, "b") / 3.0 - 1.0).abs() < 2e-3, "{found:?}");
    assert!((of(&found, "k") / 80.0 - 1.0).abs() < 2e-3, "{found:?}");

    // A derivative that was recorded goes before one that is taken.
    let still = vec![0.0; n];
    let recorded = recording("run.csv", &[("u", None, &u), ("u'", None, &still), ("x", None, &y)]);
    assert!(laid_out(BASE, &[recorded]).data.pieces[0].inputs[1].iter().all(|v| *v == 0.0));
}

#[test]
fn a_derivative_is_right_under_every_hold() {
    let n = 400;
    let t = |k: usize| k as f64 * DT;
    let u: Vec<f64> = (0..n).map(|k| (7.0 * t(k)).sin()).collect();
    let run = |hold: &str| {
        let text = BASE.replace("channel = \"u'\" }", &format!("channel = \"u'\"{hold} }}"));
        let setup = laid_out(&text, &[recording("run.csv", &[("u", None, &u), ("x", None, &u)])]);
        setup.data.pieces[0].inputs[1].clone()
    };
    let worst = |values: Vec<f64>, shift: f64| {
        let at = |k: usize| 7.0 * (7.0 * (t(k) + shift)).cos();
        (40..n - 40).map(|k| (values[k] - at(k)).abs()).fold(0.0, f64::max)
    };
    // The slope of a straight line is that of its middle.
    assert!(worst(run(""), 0.5 * DT) < 7.0 * (7.0 * DT).powi(2) / 20.0);
    assert!(worst(run(", hold = \"linear\""), 0.0) < 7.0 * (7.0 * DT).powi(2) / 5.0);
    let smooth = worst(run(", hold = \"band_limited\""), 0.0);
    assert!(smooth < 2e-3, "{smooth}");
}

fn refusal(text: &str, run: &Recording) -> String {
    let model = Model::from_toml(text, "m.toml").unwrap();
    Data::new(&model, std::slice::from_ref(run)).unwrap_err().to_string()
}

#[test]
fn what_has_no_derivative_is_refused() {
    let (u, y) = on_a_base(100);
    let run = recording("run.csv", &[("u", None, &u), ("x", None, &y)]);
    let held = refusal(&BASE.replace("u  = { unit = \"m\" }", "u = { unit = \"m\", hold = \"zero\" }"), &run);
    assert!(
        held.starts_with("run.csv: input `du` is the derivative of channel `u`, which input `u` keeps"),
        "{held}"
    );
    assert!(held.contains("write `hold = \"linear\"` at input `u`"), "{held}");
    let second = BASE.replace("unit = \"m/s\", channel = \"u'\"", "unit = \"m/s^2\", channel = \"u''\"");
    let second = refusal(&second.replace("b*(x' - du)", "m*du"), &run);
    assert!(
        second.contains("only the first derivative of a channel is taken. Record it as a channel `u''`"),
        "{second}"
    );
    let unit = refusal(
        &BASE
            .replace("u  = { unit = \"m\" }", "u = { unit = \"m\" }\nr = { unit = \"rad\" }")
            .replace("channel = \"u'\"", "channel = \"r'\"")
            .replace("k*(x - u)", "k*(x - u) + 0*k*u*r"),
        &recording("run.csv", &[("u", None, &u), ("r", None, &u), ("x", None, &y)]),
    );
    assert!(unit.contains("which the model has in `rad`, but its own unit is `m/s`"), "{unit}");
    let header = refusal(BASE, &recording("run.csv", &[("u", Some("V"), &u), ("x", None, &y)]));
    assert!(header.contains("channel `u` is in [V]"), "{header}");
    let absent = BASE.replace("u  = { unit = \"m\" }\n", "").replace(" + k*(x - u)", " + k*x");
    let absent = refusal(&absent, &recording("run.csv", &[("ub", None, &u), ("x", None, &y)]));
    assert!(
        absent.contains("there is no channel `u`, which the model's input `du` (its derivative) needs"),
        "{absent}"
    );
    assert!(absent.contains("`du = { channel = \"…'\" }`"), "{absent}");
}

/// The advice at `u'` in an equation, followed.
#[test]
fn the_advice_at_a_primed_input_works() {
    let primed = BASE.replace("du = { unit = \"m/s\", channel = \"u'\" }\n", "").replace("du)", "u')");
    let reported = Model::from_toml(&primed, "m.toml").unwrap_err();
    let help = reported.help().unwrap();
    let line = "du = { unit = \"m/s\", channel = \"u'\" }";
    assert!(help.contains(line) && help.contains("and write `du`"), "{help}");
    let followed = primed.replace("[inputs]\n", &format!("[inputs]\n{line}\n")).replace("u')", "du)");
    let (u, y) = on_a_base(500);
    let run = recording("run.csv", &[("u", None, &u), ("x", None, &y)]);
    let setup = laid_out(
        &followed.replace("value = 2.0, unit = \"N s", "value = 3.0, unit = \"N s").replace("60.0", "80.0"),
        &[run],
    );
    let parameters = setup.values();
    let run = setup.free_run(&parameters, &setup.data.sigma);
    let worst = run.y[0].iter().zip(&y).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst < 1e-3 * setup.data.spread[0], "{worst} {}", setup.data.spread[0]);
}

/// The payload stands in a column of its own, and in the mass matrix.
#[test]
fn recordings_with_different_payloads_are_fitted_together() {
    const ARM: &str = r#"
[inputs]
f  = { unit = "N" }
mp = { unit = "kg", hold = "zero" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.0, unit = "kg" }
b = { value = 1.0, unit = "N s/m" }
k = { value = 30.0, unit = "N/m" }
[equations]
mass = "(m + mp)*x'' + b*x' + k*x = f"
"#;
    let n = 1500;
    let run = |seed: u64, payload: f64| {
        let f = force(seed, n, DT, 2.0, 3.0);
        let mut y = simulated(n, |k, w, x, v| (line(&f, k, w).0 - 1.5 * v - 40.0 * x) / (1.4 + payload));
        for (y, e) in y.iter_mut().zip(normal(100 + seed, n)) {
            *y += 1e-4 * e;
        }
        let mp = vec![1e3 * payload; n];
        recording(&format!("run{seed}.csv"), &[("f", None, &f), ("mp", Some("g"), &mp), ("x", None, &y)])
    };
    let setup = laid_out(ARM, &[run(1, 0.0), run(2, 2.0)]);
    assert!(!setup.data.input_moves(1) && setup.data.input_varies(1) && setup.data.input_moves(0));
    let found = fitted(&setup);
    for (name, truth) in [("m", 1.4), ("b", 1.5), ("k", 40.0)] {
        assert!((of(&found, name) / truth - 1.0).abs() < 5e-3, "{found:?}");
    }
}

/// A supply voltage that never changes: its gain and the motor's are not separable, and the fit stays finite.
#[test]
fn a_constant_input_makes_no_infinity() {
    const DRIVE: &str = r#"
[inputs]
d = { unit = "1", hold = "zero" }
V = { unit = "V" }
enable = { unit = "1" }
[states]
x = { unit = "m" }
[parameters]
g  = { value = 1.0, unit = "m/(s^2 V)" }
g0 = { value = 0.1, unit = "m/(s^2 V)" }
c  = { value = 1.0, unit = "1/s" }
[equations]
mass = "x'' + c*x' = enable*(g*d + g0)*V"
"#;
    let n = 1000;
    let d: Vec<f64> = force(4, n, DT, 2.0, 0.3);
    let y = simulated(n, |k, _, _, v| (1.3 * d[k] + 0.05) * 7.4 - 1.6 * v);
    let (supply, one) = (vec![7.4; n], vec![1.0; n]);
    let run = recording(
        "run.csv",
        &[("d", None, &d), ("V", None, &supply), ("enable", None, &one), ("x", None, &y)],
    );
    let setup = laid_out(DRIVE, &[run]);
    assert!(!setup.data.input_moves(1) && !setup.data.input_varies(1));
    let found = fitted(&setup);
    for (name, truth) in [("g", 1.3), ("g0", 0.05), ("c", 1.6)] {
        assert!((of(&found, name) / truth - 1.0).abs() < 0.02, "{found:?}");
    }
}

/// A log of events: rows only where the input changed, and every tenth. Between them the input does what its hold says.
#[test]
fn in_rows_left_out_an_input_follows_its_hold() {
    const MASS: &str = r#"
[inputs]
f = { unit = "N", hold = "HOLD" }
[states]
x = { unit = "m", initial = [0, 0] }
[parameters]
m = { value = 1.0, unit = "kg" }
b = { value = 1.5, unit = "N s/m" }
k = { value = 20.0, unit = "N/m" }
[equations]
mass = "m*x'' + b*x' + k*x = f"
"#;
    let n = 600;
    let nodes: Vec<f64> = normal(9, n / 20 + 2);
    let steps: Vec<f64> = (0..n).map(|k| nodes[k / 20]).collect();
    let lines: Vec<f64> = (0..n)
        .map(|k| {
            let (i, w) = (k / 20, (k % 20) as f64 / 20.0);
            nodes[i] + w * (nodes[i + 1] - nodes[i])
        })
        .collect();
    for (hold, f) in [("zero", &steps), ("linear", &lines)] {
        let text = MASS.replace("HOLD", hold);
        let y = simulated(n, |k, w, x, v| {
            let f = if hold == "zero" { f[k] } else { line(f, k, w).0 };
            f - 1.5 * v - 20.0 * x
        });
        let log = |keep: &dyn Fn(usize) -> bool, cells: bool| {
            let mut csv = String::from("t,f,x\n");
            for k in 0..n {
                let t = k as f64 * DT;
                // Every tenth row, or all cells of the measurement and those of the input that are kept.
                if keep(k) {
                    csv += &format!("{t:.2},{:.12},{:.12}\n", f[k], y[k]);
                } else if cells {
                    csv += &format!("{t:.2},,{:.12}\n", y[k]);
                }
            }
            parse_csv(csv.as_bytes(), "log.csv").unwrap()
        };
        let run = |recording: Recording| {
            let setup = laid_out(&text, &[recording]);
            assert_eq!(setup.data.pieces.len(), 1);
            let parameters = setup.values();
            (
                setup.data.pieces[0].inputs[0].clone(),
                setup.free_run(&parameters, &setup.data.sigma).y[0].clone(),
            )
        };
        let changes = |k: usize| k.is_multiple_of(20) || k == n - 1;
        let (full_input, full) = run(log(&|_| true, true));
        // Cells of the input empty between its changes.
        let (input, simulated) = run(log(&changes, true));
        let worst = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst(&full_input, &input) < 1e-9, "{hold}");
        assert!(worst(&full, &simulated) < 1e-9, "{hold}: {}", worst(&full, &simulated));
        assert!(worst(&full, &y) < 2e-4, "{hold}: {}", worst(&full, &y));
        // Whole rows left out: half of each stretch between two changes.
        let rows = |k: usize| k % 20 < 8 || k % 20 > 17 || k == n - 1;
        let (input, simulated) = run(log(&rows, false));
        assert_eq!(input.len(), n, "{hold}");
        assert!(worst(&full_input, &input) < 1e-9, "{hold}");
        assert!(worst(&full, &simulated) < 1e-9, "{hold}: {}", worst(&full, &simulated));
    }
}

/// A log of switching events at times of its own: x' = u, u = 2 in some 40 stretches. What is integrated is what was
/// delivered, where the input is held; joined by lines, each event is smeared over its neighbours.
#[test]
fn between_the_rows_of_a_log_of_events_an_input_does_what_its_hold_says() {
    let steps: Vec<f64> = normal(5, 400).iter().map(|e| 1.0 + 0.2 * e.clamp(-1.5, 1.5)).collect();
    let (mut t, mut on, mut delivered) = (0.0, false, 0.0);
    let [mut time, mut u, mut x] = [const { Vec::new() }; 3];
    for (k, step) in steps.iter().enumerate() {
        if k % 9 == 0 || k % 9 == 4 {
            on = !on;
        }
        time.push(t);
        u.push(if on { 2.0 } else { 0.0 });
        x.push(delivered);
        delivered += step * u[k];
        t += step;
    }
    let channel =
        |name: &str, values: &[f64]| Channel { name: name.into(), unit: None, values: values.to_vec() };
    let columns = vec![channel("u", &u), channel("x", &x)];
    let log = Recording::from_columns("events.csv", time, columns).unwrap();
    assert!(log.pieces[0].resampled);
    let model = |hold: &str| {
        format!(
            "[inputs]\nu = {{ hold = \"{hold}\" }}\n[states]\nx = {{}}\n[parameters]\n\
             b = {{ value = 1, unit = \"1/s\", fixed = true }}\n[equations]\nfill = \"x' = b*u\"\n"
        )
    };
    let error = |hold: &str| {
        let setup = laid_out(&model(hold), std::slice::from_ref(&log));
        let piece = &setup.data.pieces[0];
        let sums = piece.inputs[0].iter().scan(0.0, |sum, u| {
            let before = *sum;
            *sum += u * piece.dt;
            Some(before)
        });
        sums.zip(&piece.measured[0]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let (held, joined) = (error("zero"), error("linear"));
    // Between its rows the level is a straight line too: nothing but rounding is left.
    assert!(held < 1e-9, "{held}");
    assert!(joined > 1.5, "more than half of what a step delivers: {joined}");
}
