//! `greybox watch` on lines from standard input.
#![allow(missing_docs, clippy::unwrap_used)]

use std::fmt::Write as _;
use std::io::Write as _;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use common::Bench;
use greybox_recording::Zone;
use running::{Broker, Running, Watching};
use serde_json::{Value, json};

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/noise.rs"]
mod noise;
#[path = "common/running.rs"]
mod running;
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
        assert_eq!(a[0]["name"], b[0]["name"]);
        let since = Zone::Offset(0).date(0, a[0]["since"].as_f64().unwrap()).unwrap();
        assert_eq!(b[0]["since"], since);
    }
}

/// Rows whose times are dates: those of the events are dates too.
#[test]
fn dates_say_the_same() {
    let bench = bench();
    let samples = throttle::samples(190.0);
    let from_csv = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &throttle::csv(&samples));
    let noon = 1_795_955_696;
    let mut rows = "t,torque [N*m],angle [rad]\n".to_owned();
    for [t, torque, angle] in &samples {
        let date = Zone::Offset(3600).date(noon, *t).unwrap();
        let _ = writeln!(rows, "{date},{torque:.5},{angle:.6}");
    }
    let dated = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &rows);
    let objects: Vec<String> = rows
        .lines()
        .skip(1)
        .map(|row| {
            let cells: Vec<&str> = row.split(',').collect();
            format!(r#"{{"at": "{}", "torque": {}, "angle": {}}}"#, cells[0], cells[1], cells[2])
        })
        .collect();
    let arguments = ["watch", "throttle.toml", "--json", "--map", "t=at"];
    assert_eq!(bench.greybox_fed(&arguments, &objects.join("\n")).stdout, dated.stdout);
    let (a, b) = (events(&from_csv.stdout), events(&dated.stdout));
    assert_eq!(a.len(), b.len());
    for (mut a, b) in a.into_iter().zip(b) {
        for key in ["t", "since"] {
            if let Some(t) = a[key].as_f64() {
                a[key] = Zone::Offset(3600).date(noon, t).into();
            }
        }
        assert_eq!(a, b);
    }
    // The same clock, anywhere: nothing jumps where the first seconds end.
    let shifted: Vec<[f64; 3]> = samples[..7000].iter().map(|[t, u, y]| [t + 12.34, *u, *y]).collect();
    let shifted = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &throttle::csv(&shifted));
    let kinds: Vec<Value> = events(&shifted.stdout).into_iter().map(|e| e["event"].clone()).collect();
    assert!(
        kinds.len() > 10 && kinds[0] == "learned" && kinds[1..].iter().all(|k| k == "estimates"),
        "{kinds:?}"
    );
    let words = bench.greybox_fed(&["watch", "throttle.toml"], &rows);
    assert!(words.stdout.contains("since 2026-11-29T13:37:26.300+01:00"), "{}", words.stdout);

    // A number after dates is no time of this clock.
    let mixed = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &format!("{rows}12.5,0,0\n"));
    let unreadable = events(&mixed.stdout).pop().unwrap();
    assert!(
        unreadable["message"].as_str().unwrap().contains("the time is a number of seconds; those before")
    );
}

/// What `ros2 topic echo --csv /joint_states` prints of a joint, `sensor_msgs/msg/JointState`: no header, a stamp in seconds and
/// nanoseconds, an empty frame, a name, position, velocity, effort.
#[test]
fn rows_without_a_header_say_the_same() {
    let bench = bench();
    let names = "--columns=t [s],t [ns],_,_,angle [rad],,torque [N*m]";
    let (mut ros, mut csv) = (String::new(), "t,torque [N*m],angle [rad]\n".to_owned());
    for [t, torque, angle] in throttle::samples(20.0) {
        let nanoseconds = 456_789 + (t * 1e9).round() as u64;
        let (sec, nanosec) = (1_795_955_696 + nanoseconds / 1_000_000_000, nanoseconds % 1_000_000_000);
        let _ = writeln!(ros, "{sec},{nanosec},,throttle_joint,{angle:?},nan,{torque:?}");
        let _ = writeln!(csv, "{sec}.{nanosec:09},{torque:?},{angle:?}");
    }
    assert!(ros.starts_with("1795955696,456789,,throttle_joint,"), "{ros:.60}");
    let watch = ["watch", "throttle.toml", "--json", "--learn", "15"];
    let from_csv = bench.greybox_fed(&watch, &csv);
    let named = [&watch[..], &[names]].concat();
    let from_ros = bench.greybox_fed(&named, &ros);
    assert_eq!(
        (from_ros.code, from_ros.stdout.as_str()),
        (0, from_csv.stdout.as_str()),
        "{}",
        from_ros.stderr
    );
    let learned = &events(&from_ros.stdout)[0];
    assert_eq!((&learned["event"], &learned["t"]), (&"learned".into(), &1_795_955_711.000_456_8.into()));

    // Rows that cannot be read: the rest of one where the stream is joined, a header, one of two joints.
    let rows = [
        "56789,,throttle_joint,0.1,nan,0.2\n",
        "sec,nanosec,frame_id,name,position,velocity,effort\n",
        &ros,
        "1795955716,0,,throttle_joint,other_joint,0.0,0.0,nan,nan,0.0,0.0\n",
    ];
    let said = bench.greybox_fed(&named, &rows.concat());
    let (unreadable, others): (Vec<Value>, Vec<Value>) =
        events(&said.stdout).into_iter().partition(|e| e["event"] == "unreadable");
    assert_eq!(others, events(&from_csv.stdout));
    let lines: Vec<&Value> = unreadable.iter().map(|e| &e["line"]).collect();
    assert_eq!(lines, [1, 2, 2003]);
    for (event, part) in unreadable.iter().zip([
        "standard input:1: cells in the row: 6; columns that are named: 7; name every column",
        "standard input:2:t (column 1): `sec` is not a number",
        "standard input:2003: cells in the row: 11; columns that are named: 7",
    ]) {
        assert!(event["message"].as_str().unwrap().starts_with(part), "{event}");
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

/// A throttle that stands still for 70 s: that nothing was told of its parameters is said, its first motion is outside what was
/// learned, and it learns anew; then its friction grows.
#[test]
fn a_machine_that_stands_still_at_first_is_learned_anew_when_it_moves() {
    const REST: f64 = 70.0;
    let bench = bench();
    let mut noise = noise::Noise(9);
    let mut samples: Vec<[f64; 3]> =
        (0..7000).map(|k| [f64::from(k) / 100.0, 0.0, 0.002 * noise.normal()]).collect();
    samples.extend(throttle::samples(190.0).iter().map(|[t, u, y]| [t + REST, *u, *y]));
    let input = throttle::csv(&samples);
    let watch = ["watch", "throttle.toml", "--json", "--state", "state.json"];
    let said = bench.greybox_fed(&watch, &input);
    assert_eq!(said.code, 0, "{}", said.stderr);
    let mut events = events(&said.stdout);
    events.retain(|e| e["event"] != "estimates");
    let kinds: Vec<&str> = events.iter().map(|e| e["event"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["learned", "outside", "learned", "changed", "settled"], "{events:?}");
    let outside = &events[1];
    assert!((0.0..2.0).contains(&(outside["t"].as_f64().unwrap() - REST)), "{outside}");
    assert!(!outside["parameters"].as_array().unwrap().is_empty(), "{outside}");
    assert_eq!(
        (&events[0]["undetermined"], &events[2]["undetermined"]),
        (&json!(["b", "c", "k"]), &json!([]))
    );
    assert!((0.0..6.0).contains(&(events[3]["t"].as_f64().unwrap() - REST - 150.0)), "{}", events[3]);
    assert_eq!(events[4]["name"], "c");
    // A state that ends while it learns anew is what was learned before.
    let part = bench.greybox_fed(&["watch", "throttle.toml"], &throttle::csv(&samples[..8000]));
    assert_eq!(part.code, 0, "{}", part.stderr);
    for words in
        ["N·m, not told by these seconds\n", ": outside what was learned: these samples say more of "]
    {
        assert!(part.stdout.contains(words), "{}", part.stdout);
    }
}

/// Values that nothing can be computed with, and one that stands alone, while it learns and afterwards: the watch goes on, and
/// every line is JSON. A block in which nothing was measured has no innovations.
#[test]
fn values_that_cannot_be_end_no_watch() {
    let bench = bench();
    let mut samples = throttle::samples(100.0);
    (samples[1000][2], samples[2010][1], samples[3000][2]) = (1e300, -1e300, 40.0);
    (samples[7000][2], samples[7510][1], samples[8000][2]) = (1e300, -1e300, 40.0);
    samples[7200][0] = 1e300;
    samples[9000..9200].iter_mut().for_each(|s| s[2] = 1e200);
    let said = bench.greybox_fed(&["watch", "throttle.toml", "--json"], &throttle::csv(&samples));
    assert_eq!(said.code, 0, "{}", said.stderr);
    let events = events(&said.stdout);
    assert!(of(&events, "changed").is_empty(), "{:?}", of(&events, "changed"));
    let count = |key: &str| of(&events, "irregular").iter().map(|e| e[key].as_u64().unwrap()).sum::<u64>();
    assert_eq!((count("outliers"), count("input_held"), count("diverged")), (2, 2, 0));
    // (A clock that jumps there and back.)
    assert_eq!(of(&events, "restarted").len(), 2);
    let estimates = of(&events, "estimates");
    assert!(estimates.iter().any(|e| e["innovations"][0][1].is_null()));
    assert!(estimates.iter().rev().take(5).all(|e| e["innovations"][0][1].is_number()));
}

/// A state that was learned with another model is refused, and it is said what differs.
#[test]
fn the_state_of_another_model_is_refused() {
    let bench = bench();
    let text = throttle::csv(&throttle::samples(20.0));
    state_after(&bench, &text);
    for (from, to, part) in [
        ("0.02,", "0.03,", "the parameter `J` is 0.02 in SI, unit [kg*m^2], fixed there, and 0.03 in SI"),
        ("k*angle =", "2*k*angle =", "the equation `plate` is "),
        ("\"zero\"", "\"linear\"", "the input `torque` is channel `torque` in [N*m], hold zero there"),
    ] {
        let other = throttle::MODEL.replacen(from, to, 1);
        assert_ne!(other, throttle::MODEL);
        bench.write("other.toml", &other);
        let said = bench.greybox_fed(&["watch", "other.toml", "--state", "fed.json"], &text);
        assert_eq!(said.code, 2, "{}", said.stderr);
        assert!(
            said.stderr.contains("fed.json: the saved state belongs to another model: "),
            "{}",
            said.stderr
        );
        assert!(said.stderr.contains(part), "{}", said.stderr);
    }
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

/// As on the page: samples published to a real MQTT broker, `mosquitto_sub` piped into the command.
#[test]
fn a_broker_is_piped_into_it() {
    let bench = bench();
    let Some(broker) = Broker::start(&bench, "allow_anonymous true") else { return };
    let samples = throttle::samples(30.0);
    let count = samples.len().to_string();
    let mut subscriber = Running(
        broker.client("mosquitto_sub", &["-C", &count, "-W", "60"]).stdout(Stdio::piped()).spawn().unwrap(),
    );
    let lines = subscriber.0.stdout.take().unwrap();
    let watch = Command::new(env!("CARGO_BIN_EXE_greybox"))
        .args(["watch", "throttle.toml", "--learn", "15", "--json"])
        .current_dir(bench.path("."))
        .stdin(lines)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    sleep(Duration::from_millis(500));
    let lines = samples
        .iter()
        .map(|[t, torque, angle]| format!(r#"{{"t": {t}, "torque": {torque:.5}, "angle": {angle:.6}}}"#));
    broker.publish(&lines.collect::<Vec<_>>(), &[]);
    let output = watch.wait_with_output().unwrap();
    assert!(output.status.success());
    let piped = String::from_utf8(output.stdout).unwrap();
    let fed =
        bench.greybox_fed(&["watch", "throttle.toml", "--learn", "15", "--json"], &throttle::csv(&samples));
    assert_eq!(piped, fed.stdout);
    assert_eq!(of(&events(&piped), "learned").len(), 1);
}

/// What the same lines leave where they end.
fn state_after(bench: &Bench, text: &str) -> (String, String) {
    let arguments = ["watch", "throttle.toml", "--json", "--learn", "15", "--state", "fed.json"];
    let said = bench.greybox_fed(&arguments, text);
    assert_eq!(said.code, 0, "{}", said.stderr);
    (said.stdout, bench.read("fed.json"))
}

/// The machine falls silent, and the watch is killed: the file has everything that came.
#[test]
fn a_kill_in_the_silence_loses_nothing() {
    let bench = bench();
    let text = throttle::csv(&throttle::samples(20.03));
    let (_, state) = state_after(&bench, &text);
    let mut watching = Watching::start(&bench, &["--learn", "15", "--state", "state.json"]);
    // (The input stays open.)
    let mut input = watching.input.take().unwrap();
    input.write_all(text.as_bytes()).unwrap();
    input.flush().unwrap();
    watching.until_saved(&bench, "state.json", &state);
    watching.process.0.kill().unwrap();
    watching.process.0.wait().unwrap();
    assert_eq!(bench.read("state.json"), state);
    assert!(bench.names().iter().all(|name| !name.ends_with(".tmp")), "{:?}", bench.names());
}

/// Killed while samples come, it has saved within the last second (and one more, for a busy machine), and goes on from there.
#[test]
fn a_kill_amid_samples_loses_a_second() {
    let bench = bench();
    let samples = throttle::samples(40.0);
    let mut watching = Watching::start(&bench, &["--learn", "15", "--state", "state.json"]);
    let mut input = watching.input.take().unwrap();
    input.write_all(throttle::csv(&samples[..2000]).as_bytes()).unwrap();
    // At the machine's own pace.
    let mut sent = 2000;
    for piece in samples[2000..2400].chunks(10) {
        let text = throttle::csv(piece);
        input.write_all(text.split_once('\n').unwrap().1.as_bytes()).unwrap();
        input.flush().unwrap();
        sent += piece.len();
        sleep(Duration::from_millis(100));
    }
    watching.process.0.kill().unwrap();
    watching.process.0.wait().unwrap();
    let age = std::fs::metadata(bench.path("state.json")).unwrap().modified().unwrap().elapsed().unwrap();
    assert!(age < Duration::from_secs(2), "{age:?}");
    let rest = ["watch", "throttle.toml", "--json", "--state", "state.json"];
    let said = bench.greybox_fed(&rest, &throttle::csv(&samples[sent..]));
    assert_eq!(said.code, 0, "{}", said.stderr);
    let events = events(&said.stdout);
    assert!(of(&events, "learned").is_empty() && !of(&events, "estimates").is_empty(), "{events:?}");
}

/// Told to end, it saves first, and ends by the signal.
#[cfg(unix)]
#[test]
fn a_watch_that_is_told_to_end_saves_its_state() {
    use std::os::unix::process::ExitStatusExt as _;
    for (name, number) in [("TERM", 15), ("INT", 2)] {
        let bench = bench();
        let text = throttle::csv(&throttle::samples(20.0));
        let (said, _) = state_after(&bench, &text);
        // Up to the row at which the last block ends.
        let last = events(&said).pop().unwrap()["t"].as_f64().unwrap();
        let text = throttle::csv(&throttle::samples(last + 0.01));
        std::fs::remove_file(bench.path("fed.json")).unwrap();
        let (said, state) = state_after(&bench, &text);
        let mut watching = Watching::start(&bench, &["--learn", "15", "--state", "state.json"]);
        let mut input = watching.input.take().unwrap();
        input.write_all(text.as_bytes()).unwrap();
        input.flush().unwrap();
        for line in said.lines() {
            assert_eq!(watching.next().0, line);
        }
        let id = watching.process.0.id().to_string();
        assert!(Command::new("kill").args(["-s", name, &id]).status().unwrap().success());
        let status = watching.process.0.wait().unwrap();
        assert_eq!(status.signal(), Some(number));
        assert_eq!(bench.read("state.json"), state);
    }
}

/// A greybox without MQTT says how to get it.
#[cfg(not(feature = "mqtt"))]
#[test]
fn a_broker_needs_the_feature() {
    let said = bench().greybox_fed(&["watch", "throttle.toml", "--from", "mqtt://u:secret@host/plant"], "");
    assert_eq!(said.code, 2);
    assert!(said.stderr.contains("mqtt://host:1883: this greybox was built without MQTT"), "{}", said.stderr);
    assert!(said.stderr.contains("mosquitto_sub -L") && !said.stderr.contains("secret"));
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
    let columns =
        |names: &str, input: &str, parts: &[&str]| refused(&[model, "--columns", names], input, parts);
    columns("t,torque,_", "", &["--columns: there is no channel `angle`", "it names `torque`", "--map"]);
    columns("t,torque,angle [m]", "", &["--columns: channel `angle` is in [m]", "[rad]"]);
    columns("sec,torque,angle", "", &["--columns: there is no time", "`t [s],t [ns]`"]);
    columns("t,angle,angle", "", &["--columns:angle (column 3): the name `angle` stands twice"]);
    let rows = "0,1\n".repeat(200);
    columns(
        "t,torque,angle",
        &rows,
        &["100 lines one after the other", "columns that are named: 3", "those not to read `_`"],
    );
    columns(
        "t,torque,angle",
        "{\"t\": 0}\n",
        &["standard input:1: this is a JSON object", "leave `--columns` out"],
    );
    columns("t,torque,angle", "m torque=0,angle=0 1\n", &["this is a line of the Influx protocol", "leave"]);
    refused(
        &[model, "--columns", "t,torque,angle", "--from", "mqtt://host/topic"],
        "",
        &["cannot be used with"],
    );
    bench.write("state.json", "{}");
    refused(&[model, "--state", "state.json"], "", &["state.json: this is no state of a watch"]);
    let late = format!("{}\n[measurements]\nangle = \"delay(angle, d)\"\n", throttle::MODEL)
        .replace("k = {", "d = { value = 0.1, unit = \"s\", fixed = true }\nk = {");
    bench.write("late.toml", &late);
    let message = "late.toml: a measurement of the model has `delay(...)`";
    refused(&["late.toml", "--learn", "10"], &short, &[message]);
}
