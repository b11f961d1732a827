//! `greybox watch` on lines from standard input.
#![allow(missing_docs, clippy::unwrap_used)]

use std::fmt::Write as _;
use std::io::Write as _;
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use common::Bench;
use serde_json::Value;

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/noise.rs"]
mod noise;
#[path = "common/throttle.rs"]
mod throttle;

fn bench() -> Bench {
    let bench = Bench::empty();
    bench.write("throttle.toml", throttle::MODEL);
    bench
}

fn events(stdout: &str) -> Vec<Value> {
    stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn of<'a>(events: &'a [Value], kind: &str) -> Vec<&'a Value> {
    events.iter().filter(|e| e["event"] == kind).collect()
}

#[test]
fn a_friction_that_grows_is_seen_and_named() {
    let bench = bench();
    let input = throttle::csv(&throttle::samples(190.0));
    let said = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &input);
    assert_eq!(said.code, 0, "{}", said.stderr);
    let events = events(&said.stdout);
    assert_eq!(events[0]["event"], "learned");
    let (changed, settled) = (of(&events, "changed"), of(&events, "settled"));
    assert_eq!((changed.len(), settled.len()), (1, 1), "{changed:?}");
    let delay = changed[0]["t"].as_f64().unwrap() - 150.0;
    assert!((0.0..6.0).contains(&delay), "{delay}");
    assert_eq!((&settled[0]["what"], &settled[0]["name"]), (&"parameter".into(), &"c".into()));
    let (now, std) = (settled[0]["now"].as_f64().unwrap(), settled[0]["std"].as_f64().unwrap());
    assert!((now - 0.13).abs() < 5.0 * std && std < 0.001, "{now} {std}");
    let estimates = of(&events, "estimates");
    assert!(estimates.len() > 20 && estimates.iter().all(|e| e["covariance"].as_array().unwrap().len() == 9));
}

/// What Telegraf writes: nanoseconds, other measurements between the samples, tags.
#[test]
fn influx_lines_say_the_same() {
    let bench = bench();
    let samples = throttle::samples(190.0);
    let from_csv = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &throttle::csv(&samples));
    let mut text = String::from("# written by Telegraf\n");
    for (k, [t, torque, angle]) in samples.iter().enumerate() {
        let ns = (t * 1e9).round() as i64;
        let _ = writeln!(text, "throttle,host=rig\\ 2 angle={angle:.6},torque={torque:.5},state=\"on\" {ns}");
        if k % 100 == 0 {
            let _ = writeln!(text, "cpu,cpu=cpu0 usage_idle=93.2 {ns}");
        }
    }
    let from_influx = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &text);
    assert_eq!(from_influx.code, 0, "{}", from_influx.stderr);
    let (a, b) = (events(&from_csv.stdout), events(&from_influx.stdout));
    assert!(of(&b, "unreadable").is_empty());
    for kind in ["changed", "settled"] {
        let (a, b) = (of(&a, kind), of(&b, kind));
        assert_eq!((a.len(), b.len()), (1, 1));
        assert_eq!((&a[0]["name"], &a[0]["since"]), (&b[0]["name"], &b[0]["since"]));
    }
}

/// JSON lines, keys within objects, other names and units, lines that cannot be read: the same events.
#[test]
fn json_lines_say_the_same() {
    let bench = bench();
    let samples = throttle::samples(190.0);
    let from_csv = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &throttle::csv(&samples));
    let mut text = String::new();
    for (k, [t, torque, angle]) in samples.iter().enumerate() {
        // (Degrees, with enough digits for the same radians up to rounding.)
        let degrees = format!("{angle:.6}").parse::<f64>().unwrap().to_degrees();
        let _ = writeln!(
            text,
            r#"{{"motor": {{"angle": {degrees}}}, "u": {torque:.5}, "t": {t}, "other": "x"}}"#
        );
        if k == 7000 {
            text.push_str("{\"t\": oops}\n\n");
        }
    }
    let map = ["--map", "angle=motor.angle [deg]", "--map", "torque=u"];
    let arguments = [&["watch", "throttle.toml", "--json"][..], &map[..]].concat();
    let from_json = bench.greybox_fed(&arguments, &text);
    assert_eq!(from_json.code, 0, "{}", from_json.stderr);
    let (a, b) = (events(&from_csv.stdout), events(&from_json.stdout));
    let unreadable = of(&b, "unreadable");
    assert_eq!(unreadable.len(), 1);
    assert_eq!(unreadable[0]["line"], 7002);
    for kind in ["changed", "settled"] {
        let (a, b) = (of(&a, kind), of(&b, kind));
        assert_eq!((a.len(), b.len()), (1, 1));
        assert_eq!((&a[0]["name"], &a[0]["t"]), (&b[0]["name"], &b[0]["t"]));
        let (x, y) = (a[0]["now"].as_f64().unwrap(), b[0]["now"].as_f64().unwrap());
        assert!((x / y - 1.0).abs() < 1e-6, "{x} {y}");
    }
}

/// A watch that ends in the middle and goes on from its file says what one that never ended says.
#[test]
fn a_state_in_a_file_is_gone_on_from() {
    let bench = bench();
    let samples = throttle::samples(190.0);
    let whole = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &throttle::csv(&samples));
    let watch = ["watch", "throttle.toml", "--json", "--state", "state.json"];
    let first = bench.greybox_fed(&watch, &throttle::csv(&samples[..10_000]));
    assert_eq!(first.code, 0, "{}", first.stderr);
    let second = bench.greybox_fed(&watch, &throttle::csv(&samples[10_000..]));
    assert_eq!(first.stdout + &second.stdout, whole.stdout);
    assert_eq!(bench.names(), ["state.json", "throttle.toml"]);
}

/// While it learns, a clock that jumps back begins anew, and one that jumps on leaves a gap.
#[test]
fn a_clock_that_jumps_in_the_first_seconds_is_reported() {
    let bench = bench();
    let samples = throttle::samples(100.0);
    let mut lines: Vec<[f64; 3]> = samples[..500].iter().map(|[t, u, y]| [t + 1e6, *u, *y]).collect();
    lines.extend(samples.iter().map(|[t, u, y]| [if *t < 30.0 { *t } else { t + 3600.0 }, *u, *y]));
    let said = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &throttle::csv(&lines));
    assert_eq!(said.code, 0, "{}", said.stderr);
    let events = events(&said.stdout);
    assert_eq!((&events[0]["event"], &events[0]["t"]), (&"restarted".into(), &0.0.into()));
    let learned = &events[1];
    assert_eq!(learned["event"], "learned");
    assert!((learned["t"].as_f64().unwrap() - 3660.0).abs() < 0.05, "{learned}");
    let k = &learned["parameters"][2];
    let (value, std) = (k["value"].as_f64().unwrap(), k["std"].as_f64().unwrap());
    assert!((value - 0.8).abs() < 5.0 * std && std < 1e-3, "{k}");
    assert!(of(&events, "changed").is_empty(), "{events:?}");
}

/// A process that ends with the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A port that is free just now.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// As on the page: samples published to a real MQTT broker, `mosquitto_sub` piped into the command.
#[test]
fn a_broker_is_piped_into_it() {
    let bench = bench();
    let port = free_port();
    // (No limit to what waits: this publisher is faster than any plant.)
    bench.write(
        "broker.conf",
        &format!("listener {port} 127.0.0.1\nallow_anonymous true\nmax_queued_messages 0\n"),
    );
    let broker =
        Command::new("mosquitto").arg("-c").arg(bench.path("broker.conf")).stderr(Stdio::null()).spawn();
    let Ok(broker) = broker else {
        eprintln!("skipped: mosquitto is not installed (Debian: mosquitto, mosquitto-clients)");
        return;
    };
    let _broker = Running(broker);
    let samples = throttle::samples(30.0);
    let (port, count) = (port.to_string(), samples.len().to_string());
    let client = |program: &str, more: &[&str]| {
        let mut command = Command::new(program);
        command.args(["-h", "127.0.0.1", "-p", &port, "-q", "1", "-t", "plant/throttle"]).args(more);
        command
    };
    // Until the broker listens.
    for _ in 0..100 {
        if client("mosquitto_pub", &["-n"]).stderr(Stdio::null()).status().is_ok_and(|s| s.success()) {
            break;
        }
        sleep(Duration::from_millis(50));
    }
    let mut subscriber =
        Running(client("mosquitto_sub", &["-C", &count, "-W", "60"]).stdout(Stdio::piped()).spawn().unwrap());
    let lines = subscriber.0.stdout.take().unwrap();
    let watch = Command::new(env!("CARGO_BIN_EXE_greybox"))
        .args(["watch", "throttle.toml", "--learn", "15", "--json"])
        .current_dir(bench.path("."))
        .stdin(lines)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    sleep(Duration::from_millis(500));
    let mut publisher = Running(client("mosquitto_pub", &["-l"]).stdin(Stdio::piped()).spawn().unwrap());
    let mut input = publisher.0.stdin.take().unwrap();
    for [t, torque, angle] in &samples {
        writeln!(input, r#"{{"t": {t}, "torque": {torque:.5}, "angle": {angle:.6}}}"#).unwrap();
    }
    drop(input);
    let output = watch.wait_with_output().unwrap();
    assert!(output.status.success());
    let piped = String::from_utf8(output.stdout).unwrap();
    let fed =
        bench.greybox_fed(&["watch", "throttle.toml", "--learn", "15", "--json"], &throttle::csv(&samples));
    assert_eq!(piped, fed.stdout);
    assert_eq!(of(&events(&piped), "learned").len(), 1);
}

#[test]
fn what_cannot_be_watched_is_refused() {
    let bench = bench();
    let refused = |arguments: &[&str], input: &str, parts: &[&str]| {
        let said = bench.greybox_fed(&[&["watch"], arguments].concat(), input);
        assert_eq!(said.code, 2, "{}", said.stderr);
        parts.iter().for_each(|part| assert!(said.stderr.contains(part), "{}", said.stderr));
    };
    let model = "throttle.toml";
    refused(&["nowhere.toml"], "", &["nowhere.toml: no such file"]);
    refused(&[model, "--learn", "0"], "", &["the time to learn is 0"]);
    refused(&[model], "", &["ended after 0 s", "--learn"]);
    let short = throttle::csv(&throttle::samples(20.0));
    refused(&[model], &short, &["the samples ended after 20.0 s, before the 60.0 s"]);
    refused(&[model, "--learn", "1"], &short, &["101 samples", "200 are needed"]);
    refused(
        &[model],
        "t,torque,phi\n0,0,0\n",
        &["standard input:1: there is no channel `angle`", "`torque`", "--map"],
    );
    refused(&[model], "t,torque,angle [m]\n0,0,0\n", &["channel `angle` is in [m]", "[rad]"]);
    refused(&[model], "0,1,2\n", &["standard input:1"]);
    refused(&[model], &format!("t,torque,angle\n{}", "x\n".repeat(200)), &["100 lines one after the other"]);
    bench.write("state.json", "{}");
    refused(&[model, "--state", "state.json"], "", &["state.json: this is no state of a watch"]);
    let late = throttle::MODEL
        .replace("k*angle", "k*delay(angle, d)")
        .replace("k =", "d = { value = 0.1, unit = \"s\" }\nk =");
    bench.write("late.toml", &late);
    refused(&["late.toml", "--learn", "10"], &short, &["late.toml: the model has `delay(...)`"]);
}
