//! A drive whose friction changes, and one whose sensor does.

use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use greybox_recursive::Direction;
use greybox_simulate::rigs::Throttle;
use greybox_watch::{Change, Event, Irregular, Options, Saved, Subject, Watch, WatchError};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const MODEL: &str = r#"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.05, unit = "N*m*s/rad" }
k = { value = 0.8, unit = "N*m/rad" }
[states]
angle = { unit = "rad" }
[equations]
drive = "J*angle'' + b*angle' + k*angle = torque"
"#;

const DT: f64 = 0.02;
/// When something happens, s.
const EVENT: f64 = 150.0;

/// What happens to the drive.
#[derive(Clone, Copy)]
struct Machine {
    /// Damping, N·m·s/rad, at a time.
    damping: fn(f64) -> f64,
    /// Offset of the sensor, rad.
    offset: fn(f64) -> f64,
    /// A torque that nobody knows, N·m.
    load: fn(f64) -> f64,
    /// Scatter of the sensor, rad.
    scatter: fn(f64) -> f64,
    /// Size of the torque that drives it, over the usual one.
    driven: fn(f64) -> f64,
}

const SOUND: Machine =
    Machine { damping: |_| 0.06, offset: |_| 0.0, load: |_| 0.0, scatter: |_| 0.002, driven: |_| 1.0 };

/// Time, torque and measured angle of every sample.
fn run(machine: Machine, seconds: f64, seed: u64) -> Vec<[f64; 3]> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let (mut state, mut torque) = ([0.0, 0.0], 0.0);
    let mut out = Vec::new();
    for k in 0..(seconds / DT) as usize {
        let t = DT * k as f64;
        if k % 10 == 0 {
            torque = 0.5 * (machine.driven)(t) * normal();
        }
        out.push([t, torque, state[0] + (machine.offset)(t) + (machine.scatter)(t) * normal()]);
        let drive = Throttle {
            viscous: (machine.damping)(t),
            coulomb: 0.0,
            load: (machine.load)(t),
            ..Throttle::NEW
        };
        state = drive.step(state, torque, DT, 10);
    }
    out
}

fn first(samples: &[[f64; 3]]) -> Recording {
    let column = |i: usize| samples.iter().map(|s| s[i]).collect::<Vec<f64>>();
    let channel =
        |name: &str, unit: &str, i| Channel { name: name.into(), unit: Some(unit.into()), values: column(i) };
    let channels = vec![channel("torque", "N*m", 1), channel("angle", "rad", 2)];
    Recording::from_columns("first", column(0), channels).unwrap()
}

fn model() -> Model {
    Model::from_toml(MODEL, "drive.toml").unwrap()
}

/// Learns from the first minute.
fn learned(samples: &[[f64; 3]], options: &Options) -> (Watch, usize) {
    learned_from(samples, options)
}

fn learned_from(samples: &[[f64; 3]], options: &Options) -> (Watch, usize) {
    let count = samples.iter().take_while(|s| s[0] < samples[0][0] + options.learn).count();
    let (watch, event) = Watch::learn(&model(), &first(&samples[..count]), options).unwrap();
    let Event::Learned(learned) = event else { panic!("{event:?}") };
    let b = &learned.parameters[0];
    assert!((b.value - 0.06).abs() < 5.0 * b.std && b.std < 1e-4, "{b:?}");
    assert!(learned.undetermined.is_empty());
    (watch, count)
}

fn push(watch: &mut Watch, samples: &[[f64; 3]]) -> Vec<Event> {
    samples.iter().flat_map(|[t, torque, angle]| watch.push(*t, &[*torque], &[*angle])).collect()
}

/// What the watch says of a machine, but for estimates.
fn watched(machine: Machine, seconds: f64, seed: u64, options: &Options) -> Vec<Event> {
    let samples = run(machine, seconds, seed);
    let (mut watch, count) = learned(&samples, options);
    let mut events = push(&mut watch, &samples[count..]);
    events.retain(|e| !matches!(e, Event::Estimates(_)));
    events
}

fn alarms(events: &[Event]) -> Vec<&Change> {
    events
        .iter()
        .filter_map(|e| match e {
            Event::Changed(change) => Some(change),
            _ => None,
        })
        .collect()
}

/// The first alarm of ten machines, its delay and what it says, each within the bounds given; none before the event.
fn seen(machine: Machine, latest: f64, is: impl Fn(&Change) -> bool) {
    for seed in 0..10 {
        let events = watched(machine, 240.0, seed, &Options::default());
        let alarms = alarms(&events);
        let alarm = alarms.first().unwrap_or_else(|| panic!("seed {seed}: nothing seen"));
        let delay = alarm.t - EVENT;
        assert!((0.0..=latest).contains(&delay) && is(alarm), "seed {seed}: {alarm:?}");
    }
}

#[test]
fn a_step_of_the_damping_is_seen_at_once_then_named_and_measured() {
    let machine = Machine { damping: |t| if t < EVENT { 0.06 } else { 0.066 }, ..SOUND };
    for seed in 0..10 {
        let events = watched(machine, 240.0, seed, &Options::default());
        let [Event::Changed(alarm), Event::Settled(settled)] = &events[..] else { panic!("{events:?}") };
        assert!((0.0..4.0).contains(&(alarm.t - EVENT)), "{alarm:?}");
        assert!((alarm.since - EVENT).abs() < 3.0, "{alarm:?}");
        // (The block in which it begins is not yet what a change of the damping makes of it.)
        let b = Subject::Parameter("b".into());
        assert!(alarm.subject == b || alarm.or.contains(&b), "{alarm:?}");
        assert_eq!((&settled.subject, &settled.or), (&b, &vec![]));
        assert_eq!((settled.direction, settled.unit.as_deref()), (Direction::Up, Some("N*m*s/rad")));
        assert!(settled.relative().is_some_and(|r| (0.09..0.11).contains(&r)), "{settled:?}");
        assert!((settled.now - 0.066).abs() < 4.0 * settled.std && settled.std < 5e-5, "{settled:?}");
    }
}

/// Half a memory after the damping another change: seen while the first one settles, which is told together with it; each is named
/// by itself, and nothing is said afterwards.
#[test]
fn a_change_is_seen_while_another_settles() {
    let machine = Machine {
        damping: |t| if t < EVENT { 0.06 } else { 0.066 },
        offset: |t| if t < EVENT + 15.0 { 0.0 } else { 0.004 },
        ..SOUND
    };
    for seed in 0..4 {
        let events = watched(machine, 300.0, seed, &Options::default());
        let [Event::Changed(_), Event::Settled(damping), Event::Changed(second), Event::Settled(offset)] =
            &events[..]
        else {
            panic!("{events:?}")
        };
        assert_eq!(damping.subject, Subject::Parameter("b".into()));
        assert!((damping.now - 0.066).abs() < 5.0 * damping.std, "{damping:?}");
        assert_eq!(damping.t, second.t);
        assert!((0.0..6.0).contains(&(second.t - EVENT - 15.0)), "{second:?}");
        let twins = [Subject::Offset("angle".into()), Subject::Force("angle".into())];
        assert!(twins.contains(&offset.subject), "{offset:?}");
        if offset.subject == twins[0] {
            assert!((offset.now - offset.before - 0.004).abs() < 5e-4, "{offset:?}");
        }
    }
}

/// A state of an earlier version is told as such.
#[test]
fn a_state_of_another_version_is_refused() {
    let (watch, _) = learned(&run(SOUND, 70.0, 6), &Options::default());
    let text = serde_json::to_string(watch.saved()).unwrap();
    assert!(serde_json::from_str::<Saved>(&text).is_ok());
    // (Such a state also lacks what came later.)
    let old = text.replace("\"version\":4", "\"version\":1").replace("\"wide\"", "\"other\"");
    let error = serde_json::from_str::<Saved>(&old).unwrap_err();
    assert!(error.to_string().contains("version 1"), "{error}");
}

/// A hundredth of the damping in a minute: seen before it is more than a fiftieth.
#[test]
fn a_ramp_of_the_damping_is_seen() {
    let machine = Machine { damping: |t| 0.06 + 1e-5 * (t - EVENT).max(0.0), ..SOUND };
    seen(machine, 30.0, |c| c.subject == Subject::Parameter("b".into()) && c.direction == Direction::Up);
}

/// At rest a load and an offset are the same to this machine: either is named, and the other beside it.
#[test]
fn a_load_and_an_offset_are_told_as_twins() {
    let twins = |c: &Change| {
        let all: Vec<&Subject> = std::iter::once(&c.subject).chain(&c.or).collect();
        all.contains(&&Subject::Force("angle".into())) && all.contains(&&Subject::Offset("angle".into()))
    };
    seen(Machine { load: |t| if t < EVENT { 0.0 } else { 0.01 }, ..SOUND }, 4.0, twins);
    seen(Machine { offset: |t| if t < EVENT { 0.0 } else { 0.003 }, ..SOUND }, 6.0, twins);
}

#[test]
fn a_sensor_that_scatters_more_is_told() {
    let machine = Machine { scatter: |t| if t < EVENT { 0.002 } else { 0.003 }, ..SOUND };
    seen(machine, 6.0, |c| c.subject == Subject::Noise("angle".into()) && c.direction == Direction::Up);
}

/// Sound machines at twenty false alarms an hour: as many as stated, less the half minutes in which one settles.
#[test]
fn false_alarms_are_as_rare_as_stated() {
    let options = Options { alarms_per_day: 480.0, ..Options::default() };
    let count: usize = (0..4).map(|seed| alarms(&watched(SOUND, 1860.0, 50 + seed, &options)).len()).sum();
    // Two hours: 40 intervals of 180 + 30 s at most; the charts are not independent. Poisson, 3 sigma.
    assert!((15..=52).contains(&count), "{count}");
}

#[test]
fn samples_that_are_not_as_they_should_be_are_reported_and_do_no_harm() {
    let samples = run(SOUND, 200.0, 3);
    let (mut watch, count) = learned(&samples, &Options::default());
    let mut events = Vec::new();
    for (k, [t, torque, angle]) in samples.iter().enumerate().skip(count) {
        let (mut t, mut torque, mut angle) = (*t, *torque, *angle);
        match k % 50 {
            7 => angle = f64::NAN,
            11 => continue,
            19 => torque = f64::INFINITY,
            23 => t = f64::NAN,
            _ => {}
        }
        events.extend(watch.push(t, &[torque], &[angle]));
        if k % 50 == 30 {
            events.extend(watch.push(t, &[torque], &[angle]));
            events.extend(watch.push(t - 3.0 * DT, &[torque], &[angle]));
        }
    }
    let mut sum = Irregular::default();
    for event in &events {
        if let Event::Irregular(i) = event {
            sum.late += i.late;
            sum.repeated += i.repeated;
            sum.missing += i.missing;
            sum.not_measured += i.not_measured;
            sum.input_held += i.input_held;
            assert_eq!(i.diverged, 0);
        }
    }
    // Of each kind one in fifty samples, 140 in all, but for the last blocks; a time that is no number is late, and leaves
    // a gap.
    for (found, of) in [(sum.late, 280), (sum.repeated, 140), (sum.not_measured, 140), (sum.input_held, 140)]
    {
        assert!((of * 2 / 5..=of).contains(&found), "{sum:?}");
    }
    assert!(sum.missing > 80, "{sum:?}");
    let estimates = events.iter().rev().find_map(|e| match e {
        Event::Estimates(estimates) => Some(estimates),
        _ => None,
    });
    let b = &estimates.unwrap().parameters[0];
    assert!((b.value - 0.06).abs() < 5e-4, "{b:?}");
}

#[test]
fn a_clock_that_jumps_begins_anew_and_keeps_what_was_learned() {
    let samples = run(SOUND, 120.0, 4);
    let (mut watch, count) = learned(&samples, &Options::default());
    push(&mut watch, &samples[count..4000]);
    for shift in [1000.0, -500.0] {
        let moved: Vec<[f64; 3]> = samples[4000..5500].iter().map(|[t, u, y]| [t + shift, *u, *y]).collect();
        let events = push(&mut watch, &moved);
        assert!(matches!(&events[0], Event::Restarted(clock) if clock.t == moved[0][0]), "{:?}", events[0]);
        assert!(events[1..].iter().all(|e| matches!(e, Event::Estimates(_))), "{events:?}");
    }
}

/// Saved and restored in the middle, the watch says what it would have said, to the last digit.
#[test]
fn a_saved_watch_goes_on_as_if_nothing_had_been() {
    let machine = Machine { damping: |t| if t < EVENT { 0.06 } else { 0.08 }, ..SOUND };
    let samples = run(machine, 200.0, 5);
    let (mut watch, count) = learned(&samples, &Options::default());
    let text = serde_json::to_string(watch.saved()).unwrap();
    let whole = push(&mut watch, &samples[count..]);
    let mut parts = Vec::new();
    let mut saved = text;
    for chunk in samples[count..].chunks(1111) {
        let mut watch = Watch::restore(&model(), serde_json::from_str(&saved).unwrap()).unwrap();
        parts.extend(push(&mut watch, chunk));
        saved = serde_json::to_string(watch.saved()).unwrap();
    }
    assert_eq!(whole, parts);
}

/// What a watch says, but for estimates, up to the first block outside what was learned, and how many samples that took.
fn until_outside(watch: &mut Watch, samples: &[[f64; 3]]) -> (Vec<Event>, usize) {
    let mut said = Vec::new();
    for (k, sample) in samples.iter().enumerate() {
        said.extend(push(watch, &[*sample]).into_iter().filter(|e| !matches!(e, Event::Estimates(_))));
        if matches!(said.last(), Some(Event::Outside(_))) {
            return (said, k + 1);
        }
    }
    (said, samples.len())
}

/// A drive that stands still for the first minute and more: its first motion is outside what was learned, and no fault. Learned
/// anew from there on, a change is seen and named.
#[test]
fn the_first_motion_of_a_machine_that_stood_still_is_no_fault() {
    for seed in 0..6 {
        let machine = Machine {
            driven: |t| if t < 80.0 { 0.0 } else { 1.0 },
            damping: |t| if t < EVENT + 30.0 { 0.06 } else { 0.066 },
            ..SOUND
        };
        let samples = run(machine, 270.0, seed);
        let (mut watch, event) =
            Watch::learn(&model(), &first(&samples[..3000]), &Options::default()).unwrap();
        let Event::Learned(still) = event else { panic!("{event:?}") };
        // (The noise of a machine at rest may pass for a little of k.)
        assert!(still.undetermined.contains(&"b".to_owned()), "seed {seed}: {:?}", still.undetermined);
        let (said, count) = until_outside(&mut watch, &samples[3000..]);
        let [Event::Outside(outside)] = &said[..] else { panic!("seed {seed}: {said:?}") };
        assert!((80.0..82.0).contains(&outside.t), "seed {seed}: {outside:?}");
        assert!(outside.parameters.iter().any(|p| p == "b" || p == "k"), "seed {seed}: {outside:?}");
        let rest = &samples[3000 + count..];
        let (mut watch, begun) = learned_from(rest, &Options::default());
        let mut events = push(&mut watch, &rest[begun..]);
        events.retain(|e| !matches!(e, Event::Estimates(_)));
        let [Event::Changed(alarm), Event::Settled(settled)] = &events[..] else {
            panic!("seed {seed}: {events:?}")
        };
        assert!((0.0..4.0).contains(&(alarm.t - EVENT - 30.0)), "seed {seed}: {alarm:?}");
        assert_eq!(settled.subject, Subject::Parameter("b".into()), "seed {seed}");
    }
}

/// Twice the torque, or a tenth of it, is still what was learned: nothing is said, and nothing is outside.
#[test]
fn more_or_less_of_the_same_motion_is_not_outside() {
    for driven in [|t: f64| if t < 100.0 { 1.0 } else { 2.0 }, |t: f64| if t < 100.0 { 1.0 } else { 0.1 }] {
        let events = watched(Machine { driven, ..SOUND }, 240.0, 3, &Options::default());
        assert!(events.is_empty(), "{events:?}");
    }
}

/// One value that is far off while it learns: not used, and said; a change is seen afterwards as if it had not been.
#[test]
fn an_outlier_in_the_first_seconds_hides_no_change() {
    let machine = Machine { damping: |t| if t < EVENT { 0.06 } else { 0.066 }, ..SOUND };
    for (seed, size) in [(0, 1.0), (1, -30.0), (2, 1e6)] {
        let mut samples = run(machine, 240.0, seed);
        samples[1234][2] += size;
        let (mut watch, count) = learned(&samples, &Options::default());
        let mut events = push(&mut watch, &samples[count..]);
        events.retain(|e| !matches!(e, Event::Estimates(_)));
        let [Event::Irregular(irregular), Event::Changed(alarm), Event::Settled(settled)] = &events[..]
        else {
            panic!("{events:?}")
        };
        assert_eq!(*irregular, Irregular { outliers: 1, ..Irregular::default() });
        assert!((0.0..4.0).contains(&(alarm.t - EVENT)), "{alarm:?}");
        assert_eq!(settled.subject, Subject::Parameter("b".into()));
    }
}

/// Values that stand alone, and values that nothing can be computed with, while it is watched: none is used, all are counted, and
/// the watch says nothing else, whatever their size. Its state can be saved and restored after each.
#[test]
fn a_value_that_is_far_off_does_no_harm() {
    let samples = run(SOUND, 200.0, 7);
    for size in [0.1, 3.0, 1e6, 1e90, 1e300, f64::INFINITY] {
        let (mut watch, count) = learned(&samples, &Options::default());
        let mut bad = samples[count..].to_vec();
        for k in (500..5000).step_by(500) {
            bad[k][2] += size;
        }
        let events = push(&mut watch, &bad);
        let (mut alone, mut unused) = (0, 0);
        for event in &events {
            match event {
                Event::Estimates(_) => {}
                Event::Irregular(i) => {
                    (alone, unused) = (alone + i.outliers, unused + i.not_measured);
                    assert_eq!((i.diverged, i.late, i.missing), (0, 0, 0));
                }
                other => panic!("{size}: {other:?}"),
            }
        }
        assert!(alone + unused >= 8 && (size < 1e100) == (alone > 0), "{size}: {alone} {unused}");
        let text = serde_json::to_string(watch.saved()).unwrap();
        assert!(Watch::restore(&model(), serde_json::from_str(&text).unwrap()).is_ok(), "{size}");
        let Some(Event::Estimates(last)) = events.last() else { panic!("{events:?}") };
        assert!((last.parameters[0].value - 0.06).abs() < 5e-4, "{size}: {last:?}");
    }
}

/// Inputs and times of any size: the watch goes on, and knows the damping again a few memories later.
#[test]
fn inputs_and_times_of_any_size_end_nothing() {
    let samples = run(SOUND, 400.0, 8);
    for size in [1e20, 1e99, 1e300, f64::NAN] {
        let (mut watch, count) = learned(&samples, &Options::default());
        let mut bad = samples[count..].to_vec();
        (bad[700][1], bad[1400][0]) = (size, size);
        let events = push(&mut watch, &bad);
        let Some(Event::Estimates(last)) = events.last() else { panic!("{events:?}") };
        assert!((last.parameters[0].value - 0.06).abs() < 1e-3, "{size}: {last:?}");
        let text = serde_json::to_string(watch.saved()).unwrap();
        assert!(Watch::restore(&model(), serde_json::from_str(&text).unwrap()).is_ok(), "{size}");
    }
}

/// Paths of all arrays that are not empty.
fn arrays(value: &serde_json::Value, path: &str) -> Vec<String> {
    let inner: Vec<(String, &serde_json::Value)> = match value {
        serde_json::Value::Array(a) => a.iter().enumerate().map(|(k, v)| (k.to_string(), v)).collect(),
        serde_json::Value::Object(o) => o.iter().map(|(k, v)| (k.clone(), v)).collect(),
        _ => Vec::new(),
    };
    let own = value.as_array().filter(|a| !a.is_empty()).map(|_| path.to_owned());
    // (Of arrays of arrays the first two are enough.)
    let most = if value.is_array() { 2 } else { usize::MAX };
    let below = inner.iter().take(most).flat_map(|(k, v)| arrays(v, &format!("{path}/{k}")));
    own.into_iter().chain(below).collect()
}

#[test]
fn what_cannot_be_watched_is_refused() {
    let samples = run(SOUND, 70.0, 6);
    let recording = first(&samples);
    let refused = |text: &str, recording: &Recording, options: Options| {
        let model = Model::from_toml(text, "drive.toml").unwrap();
        Watch::learn(&model, recording, &options).map(|_| ()).unwrap_err()
    };
    let usual = Options::default();
    let late = format!("{MODEL}\n[measurements]\nangle = \"delay(angle, tau)\"")
        .replace("k = {", "tau = { value = 0.02, unit = \"s\", fixed = true }\nk = {");
    assert_eq!(refused(&late, &recording, usual), WatchError::DelayedMeasurement);
    let fixed = MODEL
        .replace("rad\" }\nk", "rad\", fixed = true }\nk")
        .replace("m/rad\" }", "m/rad\", fixed = true }");
    assert_eq!(refused(&fixed, &recording, usual), WatchError::NothingFree);
    let short = first(&samples[..100]);
    assert!(matches!(refused(MODEL, &short, usual), WatchError::TooShort { samples: 100, .. }));
    let other = MODEL.replace("angle = { unit", "angle = { channel = \"phi\", unit");
    assert!(matches!(refused(&other, &recording, usual), WatchError::Data(_)));
    let never = Options { alarms_per_day: 0.0, ..usual };
    assert!(matches!(refused(MODEL, &recording, never), WatchError::Option { .. }));

    let (watch, _) = learned(&samples, &usual);
    // States that somebody has tampered with: every array of the file cut by one entry, one after the other.
    let text = serde_json::to_value(watch.saved()).unwrap();
    let mut refused = 0;
    for path in arrays(&text, "") {
        let mut cut = text.clone();
        cut.pointer_mut(&path).unwrap().as_array_mut().unwrap().pop();
        if let Ok(saved) = serde_json::from_value(cut) {
            match Watch::restore(&model(), saved) {
                Ok(mut watch) => drop(push(&mut watch, &samples[3000..3500])),
                Err(_) => refused += 1,
            }
        }
    }
    assert!(refused > 15, "{refused}");
    let other = Model::from_toml(&MODEL.replace("b =", "c =").replace("b*", "c*"), "other.toml").unwrap();
    let error = Watch::restore(&other, watch.saved().clone()).map(|_| ()).unwrap_err();
    assert!(error.to_string().contains("the parameter `c` is not in it"), "{error}");
}
