//! Closed loops: tracking, friction, families of plants, units.

use crate::common::{CART, PENDULUM, load};
use greybox_control::{
    ClosedLoop, ControlError, DesignOptions, FamilyOptions, Feedback, LoopOptions, Method, Plant,
    PlantOptions, Reference, design,
};

fn sized(sizes: &[(&str, f64)], input_size: f64) -> PlantOptions {
    PlantOptions {
        sizes: sizes.iter().map(|(n, s)| ((*n).to_owned(), *s)).collect(),
        input_size,
        ..PlantOptions::default()
    }
}

#[test]
fn a_pendulum_is_held_anywhere() {
    let model = load(PENDULUM);
    let plant = Plant::of(&model, "tau", &sized(&[("theta", 1.0), ("theta'", 10.0)], 1.0)).unwrap();
    let set_points = [-2.0, -0.5, 0.0, 1.5, 2.5];
    for method in [
        Method::Lqr,
        Method::Hjb { degree: 6, domain: vec![4.5, 20.0], bounded: false },
        Method::Smc { lambda: 10.0, eta: 4.0, phi: 0.2 },
    ] {
        let law = design(&plant, &method, &DesignOptions::new("theta", &set_points, 2e-3)).unwrap();
        assert_eq!(law.limits(), (-3.0, 3.0));
        let reference = Reference::SetPoints {
            set_points: set_points.iter().enumerate().map(|(k, r)| (3.0 * k as f64, *r)).collect(),
            duration: 15.0,
        };
        let run = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap().run(&reference).unwrap();
        assert_eq!((run.diverged, run.metrics.len(), run.t.len()), (None, 5, 7501));
        for m in &run.metrics {
            println!("{} {m:?}", method.name());
            // Beyond the horizontal, gravity takes most of the stiffness that the gains of the middle make.
            let smc = matches!(method, Method::Smc { .. });
            let slow = if !smc && m.set_point == 2.5 { 100.0 } else { 1.0 };
            assert!(m.final_error.abs() < 2e-4 * slow, "{}: {m:?}", method.name());
            assert!(m.largest_command <= 3.0);
        }
        // From angles alone, with the rate by differences.
        let options = LoopOptions { feedback: Feedback::Differences, ..LoopOptions::default() };
        let run = ClosedLoop::new(&model, &law, &options).unwrap().run(&reference).unwrap();
        assert!(run.metrics[..4].iter().all(|m| m.final_error.abs() < 2e-4), "{}", method.name());
    }
}

#[test]
fn scheduled_gains_reach_far_set_points_as_fast() {
    let model = load(PENDULUM);
    let plant = Plant::of(&model, "tau", &sized(&[("theta", 1.0), ("theta'", 10.0)], 1.0)).unwrap();
    let wanted = DesignOptions::new("theta", &[-2.5, 0.0, 2.5], 2e-3);
    let law =
        |scheduled| design(&plant, &Method::Lqr, &DesignOptions { scheduled, ..wanted.clone() }).unwrap();
    let (constant, scheduled) = (law(false), law(true));
    let slowest = |c: &greybox_control::Check| c.poles[0].re;
    // At the middle they are one.
    for (a, b) in constant.gains().iter().zip(scheduled.gains()) {
        assert!((a - b).abs() < 1e-3 * a, "{a} {b}");
    }
    assert!(slowest(&constant.checks()[2]) > -2.5 && slowest(&scheduled.checks()[2]) < -3.5);
    let run =
        ClosedLoop::new(&model, &scheduled, &LoopOptions::default()).unwrap().run(&Reference::step(2.5, 4.0));
    let m = run.unwrap().metrics[0];
    assert!(m.final_error.abs() < 2e-4 && m.settling.is_some_and(|t| t < 1.5), "{m:?}");
}

#[test]
fn a_dead_zone_of_the_input_is_made_up_for() {
    let text = PENDULUM
        .replace("saturate(tau, lim)", "saturate(deadzone(tau, gap), lim)")
        .replace("[equations]", "gap = { value = 0.2, unit = \"N m\" }\n[equations]");
    let model = load(&text);
    let plant = Plant::of(&model, "tau", &sized(&[("theta", 1.0), ("theta'", 10.0)], 1.0)).unwrap();
    assert_eq!(plant.dead_zone(), 0.2);
    for method in [Method::Lqr, Method::Smc { lambda: 10.0, eta: 4.0, phi: 0.2 }] {
        let law = design(&plant, &method, &DesignOptions::new("theta", &[-0.5, 0.5], 2e-3)).unwrap();
        let run = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
        let run = run.run(&Reference::square(0.5, 3.0, 3)).unwrap();
        for m in &run.metrics {
            assert!(m.final_error.abs() < 1e-3 && m.settling.is_some(), "{}: {m:?}", method.name());
        }
    }
}

#[test]
fn a_cart_with_coulomb_friction_sticks_where_the_law_is_weaker() {
    let model = load(CART);
    let plant = Plant::of(&model, "u", &sized(&[("x", 0.5), ("x'", 1.0)], 20.0)).unwrap();
    for method in [Method::Lqr, Method::Smc { lambda: 8.0, eta: 20.0, phi: 2.0 }] {
        let law = design(&plant, &method, &DesignOptions::new("x", &[0.0, 1.0], 5e-3)).unwrap();
        let run = ClosedLoop::new(&model, &law, &LoopOptions::default())
            .unwrap()
            .run(&Reference::step(1.0, 10.0))
            .unwrap();
        let m = run.metrics[0];
        println!("{} {m:?} K {:?}", method.name(), law.gains());
        assert!(m.final_error.abs() <= 1.0001 * 1.5 / law.gains()[0], "{m:?}");
        // It creeps to where it sticks, and never chatters.
        let turns = run.x[1].windows(2).filter(|v| v[0] * v[1] < 0.0).count();
        assert!(turns <= 1 && run.x[1][run.t.len() - 1].abs() < 1e-5, "{turns}");
    }
}

#[test]
fn families_are_the_same_whatever_the_threads() {
    let model = load(CART);
    let plant = Plant::of(&model, "u", &sized(&[("x", 0.5), ("x'", 1.0)], 20.0)).unwrap();
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("x", &[0.0, 1.0], 5e-3)).unwrap();
    let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
    let reference = Reference::step(1.0, 3.0);
    let options = FamilyOptions {
        deviations: vec![("m".into(), 0.4), ("b".into(), 0.2), ("fc".into(), 0.5)],
        members: 24,
        seed: 7,
    };
    let family = looped.family(&reference, &options).unwrap();
    println!("{family:?}");
    assert_eq!((family.members, family.diverged), (24, 0));
    assert!(family.final_error.median <= family.final_error.worst && family.final_error.worst < 0.3);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let again = pool.install(|| looped.family(&reference, &options)).unwrap();
        assert_eq!(format!("{again:?}"), format!("{family:?}"));
    }
    let other = looped.family(&reference, &FamilyOptions { seed: 8, ..options.clone() }).unwrap();
    assert_ne!(other, family);
    // Without deviations every member is the model.
    let same = FamilyOptions { deviations: vec![], ..options.clone() };
    let same = looped.family(&reference, &same).unwrap();
    let run = looped.run(&reference).unwrap();
    assert_eq!((same.effort.median, same.effort.worst), (run.metrics[0].effort, run.metrics[0].effort));
    assert_eq!((&same.tracked.lowest, &same.tracked.highest), (&run.x[0], &run.x[0]));
    assert_eq!((&same.command.lowest, &same.command.highest), (&run.u, &run.u));
    // The largest command of all members stands on the edge of the band.
    let edges = family.command.lowest.iter().chain(&family.command.highest);
    assert_eq!(edges.fold(0.0f64, |m, u| m.max(u.abs())), family.largest_command.worst);
    assert!(family.tracked.lowest != family.tracked.highest);
    assert!(family.tracked.lowest.iter().zip(&family.tracked.highest).all(|(low, high)| low <= high));
    let unknown = FamilyOptions { deviations: vec![("g".into(), 1.0)], ..options.clone() };
    let error = looped.family(&reference, &unknown).unwrap_err();
    assert!(matches!(error, ControlError::UnknownParameter { .. }), "{error}");
    for bad in [
        FamilyOptions { members: 0, ..options.clone() },
        FamilyOptions { deviations: vec![("m".into(), f64::NAN)], ..options },
    ] {
        assert!(matches!(looped.family(&reference, &bad), Err(ControlError::Option { .. })));
    }
}

/// On a linear cart the plants whose linearised loop is unstable are those whose simulated loop runs away.
#[test]
fn a_plant_without_margin_is_one_that_runs_away() {
    let model = load(
        &CART
            .replace("fc = { value = 1.5", "fc = { value = 0.0")
            .replace("= u\"", "= k*u\"")
            .replace("[equations]", "k = { value = 1.0, unit = \"1\" }\n[equations]"),
    );
    let plant = Plant::of(&model, "u", &sized(&[("x", 0.01), ("x'", 1.0)], 20.0)).unwrap();
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("x", &[0.0, 1.0], 0.02)).unwrap();
    let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
    let options = FamilyOptions { deviations: vec![("k".into(), 6.0)], members: 40, seed: 2 };
    let family = looped.family(&Reference::step(1.0, 100.0), &options).unwrap();
    println!("{} {} {:?} {:?}", family.unstable, family.diverged, family.margins, law.margins());
    assert_eq!(family.unstable, family.diverged);
    assert!((5..36).contains(&family.unstable), "{}", family.unstable);
    let margins = family.margins.unwrap();
    assert_eq!(margins.worst(), greybox_control::Margins::NONE);
    assert!(margins.median().phase > 0.0 || family.unstable > 20);
    let few = FamilyOptions { deviations: vec![("k".into(), 0.05)], members: 10, seed: 2 };
    let few = looped.family(&Reference::step(1.0, 1.0), &few).unwrap();
    let (own, worst) = (law.margins()[0].unwrap(), few.margins.unwrap().worst());
    // Draws of one standard deviation and a half or so.
    assert!(
        few.unstable == 0 && worst.gain < own.gain / 1.02 && worst.gain > own.gain / 1.2,
        "{worst:?} {own:?}"
    );
}

#[test]
fn what_runs_away_is_told() {
    // A plant ten times as light as the law believes, with a slow sample: the loop rings ever more.
    let model = load(CART);
    let plant = Plant::of(&model, "u", &sized(&[("x", 0.01), ("x'", 1.0)], 20.0)).unwrap();
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("x", &[0.0, 1.0], 0.02)).unwrap();
    let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
    let run = looped.run_with(&[0.02, 0.0, 0.0], &Reference::step(1.0, 20.0)).unwrap();
    assert!(run.diverged.is_some_and(|k| k < 1000 && run.t.len() == k + 1), "{:?}", run.diverged);
    assert!(run.metrics.iter().all(|m| m.settling.is_none()));
    let reference = |set_points: &[(f64, f64)], duration: f64| Reference::SetPoints {
        set_points: set_points.to_vec(),
        duration,
    };
    for bad in [
        reference(&[], 1.0),
        reference(&[(1.0, 0.0)], 2.0),
        reference(&[(0.0, 1.0), (0.0, 2.0)], 2.0),
        reference(&[(0.0, f64::NAN)], 2.0),
        reference(&[(0.0, 1.0)], f64::NAN),
        reference(&[(0.0, 1.0)], 1e12),
        reference(&[(0.0, 1.0)], -1.0),
    ] {
        assert!(matches!(looped.run(&bad), Err(ControlError::Option { .. })), "{bad:?}");
    }
    assert!(matches!(looped.run_with(&[1.0], &Reference::step(1.0, 1.0)), Err(ControlError::Size { .. })));
    let start = LoopOptions { start: Some(vec![0.0]), ..LoopOptions::default() };
    assert!(matches!(ClosedLoop::new(&model, &law, &start), Err(ControlError::Size { .. })));
    let other = load(PENDULUM);
    assert!(matches!(
        ClosedLoop::new(&other, &law, &LoopOptions::default()),
        Err(ControlError::Foreign { .. })
    ));
}

#[test]
fn the_law_runs_on_a_fuller_model() {
    // A delay of the input and a lag that the design did not know of.
    let fuller = CART
        .replace("fc*sign(x') = u", "fc*sign(x') = ua\"\nlag = \"ta*ua' + ua = delay(u, td)")
        .replace("x = { unit = \"m\" }", "x = { unit = \"m\" }\nua = { unit = \"N\", measured = false }")
        .replace(
            "[equations]",
            "ta = { value = 0.01, unit = \"s\" }\ntd = { value = 0.012, unit = \"s\" }\n[equations]",
        );
    let (model, fuller) = (load(CART), load(&fuller));
    let plant = Plant::of(&model, "u", &sized(&[("x", 0.5), ("x'", 1.0)], 20.0)).unwrap();
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("x", &[0.0, 1.0], 5e-3)).unwrap();
    let run = |model, reference: &Reference| {
        ClosedLoop::new(model, &law, &LoopOptions::default()).unwrap().run(reference).unwrap()
    };
    let reference = Reference::step(1.0, 3.0);
    let (plain, full) = (run(&model, &reference), run(&fuller, &reference));
    assert_eq!(full.states, ["x", "x'", "ua"]);
    assert!(full.metrics[0].final_error.abs() < 0.1 && full.diverged.is_none());
    // The first samples see nothing of the command: delay(u) is the first command before the start.
    assert_eq!(plain.u[0], full.u[0]);
    assert_ne!(plain.u[50], full.u[50]);
    // A delay of nothing is none.
    let mut without = fuller.clone();
    let td = without.parameter("td").unwrap();
    without.parameters[td].value = 1e-9;
    let mut direct = fuller.clone();
    direct.equations[1].rhs = greybox_model::parse("u").unwrap().expr;
    let (a, b) = (run(&without, &reference), run(&direct, &reference));
    for (a, b) in a.x[0].iter().zip(&b.x[0]) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
}

/// A mass on a hardening spring, its position counted in 1/`by` m and its force in 1/`per` N.
fn spring(by: f64, per: f64) -> String {
    format!(
        "[inputs]\nu = {{}}\n[states]\nx = {{}}\n[parameters]\nm = {{ value = {} }}\nb = {{ value = {} }}\n\
         k = {{ value = {} }}\nkk = {{ value = {} }}\n[equations]\nmass = \"m*x'' + b*x' + k*x + kk*x^3 = u\"\n",
        2.0 / by * per,
        0.5 / by * per,
        3.0 / by * per,
        4.0 / by.powi(3) * per
    )
}

#[test]
fn units_play_no_part() {
    let response = |by: f64, per: f64, method: &Method| {
        let model = load(&spring(by, per));
        let plant = Plant::of(&model, "u", &sized(&[("x", 0.5 * by), ("x'", 2.0 * by)], 10.0 * per)).unwrap();
        let wanted = DesignOptions::new("x", &[-0.8 * by, 0.8 * by], 4e-3);
        let law = design(&plant, method, &DesignOptions { limit: Some(15.0 * per), ..wanted }).unwrap();
        let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
        let run = looped.run(&Reference::square(0.8 * by, 3.0, 2)).unwrap();
        let x: Vec<f64> = run.x[0].iter().map(|x| x / by).collect();
        (x, run.u.iter().map(|u| u / per).collect::<Vec<f64>>())
    };
    for (by, per) in [(1e3, 1.0), (1e6, 1e-3), (1e-2, 1e4)] {
        let methods = [
            (Method::Lqr, Method::Lqr),
            (
                Method::Hjb { degree: 6, domain: vec![1.7, 6.0], bounded: false },
                Method::Hjb { degree: 6, domain: vec![1.7 * by, 6.0 * by], bounded: false },
            ),
            (
                Method::Smc { lambda: 6.0, eta: 30.0, phi: 2.0 },
                Method::Smc { lambda: 6.0, eta: 30.0 * per, phi: 2.0 * per },
            ),
        ];
        for (one, other) in methods {
            let ((x, u), (y, v)) = (response(1.0, 1.0, &one), response(by, per, &other));
            let apart =
                |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(apart(&x, &y) < 1e-6, "{} {by} {per}: {}", one.name(), apart(&x, &y));
            assert!(apart(&u, &v) < 1e-4, "{} {by} {per}: {}", one.name(), apart(&u, &v));
            assert!((x[749] - 0.8).abs() < 1e-3, "{}: {}", one.name(), x[749]);
        }
    }
}

/// A pole balanced on a cart, angle from upright.
pub(crate) const CART_POLE: &str = r#"
[inputs]
u = { unit = "N" }
[states]
x = { unit = "m" }
th = { unit = "rad" }
[parameters]
M = { value = 1.0, unit = "kg" }
m = { value = 0.2, unit = "kg" }
l = { value = 0.5, unit = "m" }
g = { value = 9.81, unit = "m/s^2" }
b = { value = 0.1, unit = "N s/m" }
[equations]
cart = "(M + m)*x'' + m*l*cos(th)*th'' - m*l*sin(th)*th'^2 + b*x' = u"
pole = "cos(th)*x'' + l*th'' - g*sin(th) = 0"
"#;

#[test]
fn a_pole_is_balanced_while_the_cart_moves() {
    let model = load(CART_POLE);
    let sizes = [("x", 0.3), ("x'", 1.0), ("th", 0.2), ("th'", 1.0)];
    let plant = Plant::of(&model, "u", &sized(&sizes, 10.0)).unwrap();
    let mut wanted = DesignOptions::new("x", &[-0.3, 0.3], 5e-3);
    wanted.limit = Some(20.0);
    for method in [
        Method::Lqr,
        Method::Hjb { degree: 4, domain: vec![1.0, 3.0, 0.6, 3.0], bounded: false },
        Method::Smc { lambda: 2.5, eta: 40.0, phi: 4.0 },
    ] {
        let law = design(&plant, &method, &wanted).unwrap();
        let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
        let run = looped.run(&Reference::square(0.3, 8.0, 3)).unwrap();
        // From where the actuator cannot catch the pole, it falls, and swings.
        let fallen = LoopOptions { start: Some(vec![0.0, 0.0, 1.2, 0.0]), ..LoopOptions::default() };
        let fallen = ClosedLoop::new(&model, &law, &fallen).unwrap().run(&Reference::step(0.0, 2.0)).unwrap();
        assert!(fallen.diverged.is_some() || fallen.metrics[0].settling.is_none(), "{}", method.name());
        for m in &run.metrics {
            println!("{} {m:?}", method.name());
            assert!(m.final_error.abs() < 2e-3 && m.settling.is_some(), "{}: {m:?}", method.name());
        }
        let deviations = vec![("m".into(), 0.04), ("l".into(), 0.05), ("b".into(), 0.05)];
        let family = FamilyOptions { deviations, members: 16, seed: 3 };
        let family = looped.family(&Reference::square(0.3, 8.0, 2), &family).unwrap();
        println!("{} {family:?}", method.name());
        assert_eq!((family.diverged, family.settled), (0, 16));
    }
}

#[test]
fn a_law_without_the_memory_of_friction_runs_on_the_model_with_it() {
    // Dahl's friction (a spring of 400 N/m that yields at 1.5 N).
    let text = CART
        .replace("fc*sign(x') = u", "s*z = u\"\nmemory = \"z' = x' - s/fc*abs(x')*z")
        .replace("x = { unit = \"m\" }", "x = { unit = \"m\" }\nz = { unit = \"m\", measured = false }")
        .replace("[equations]", "s = { value = 400.0, unit = \"N/m\" }\n[equations]");
    let model = load(&text);
    let mut options = sized(&[("x", 0.5), ("x'", 1.0)], 20.0);
    options.frozen = vec![("z".into(), 0.0)];
    let plant = Plant::of(&model, "u", &options).unwrap();
    for method in [Method::Lqr, Method::Smc { lambda: 8.0, eta: 20.0, phi: 2.0 }] {
        let law = design(&plant, &method, &DesignOptions::new("x", &[0.0, 1.0], 5e-3)).unwrap();
        let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
        let run = looped.run(&Reference::step(1.0, 6.0)).unwrap();
        assert_eq!(run.states, ["x", "x'", "z"]);
        assert!(run.metrics[0].final_error.abs() < 1.01 * 1.5 / law.gains()[0], "{:?}", run.metrics);
        let differences = LoopOptions { feedback: Feedback::Differences, ..LoopOptions::default() };
        let run =
            ClosedLoop::new(&model, &law, &differences).unwrap().run(&Reference::step(1.0, 6.0)).unwrap();
        assert!(run.metrics[0].final_error.abs() < 1.01 * 1.5 / law.gains()[0], "{:?}", run.metrics);
    }
    // With it in the law, what is not measured is missed.
    let lag = load(
        "[inputs]\nu = {}\n[states]\nx = {}\ny = { measured = false }\n[parameters]\nk = { value = 3.0 }\n\
                    [equations]\none = \"x' + k*x = y\"\ntwo = \"y' + k*y = u\"\n",
    );
    let plant = Plant::of(&lag, "u", &PlantOptions::default()).unwrap();
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("x", &[0.0], 5e-3)).unwrap();
    let differences = LoopOptions { feedback: Feedback::Differences, ..LoopOptions::default() };
    let error = ClosedLoop::new(&lag, &law, &differences).unwrap_err();
    assert!(matches!(&error, ControlError::Unmeasured { name } if name == "y"), "{error}");
}

#[test]
fn a_gap_is_designed_as_closed_and_simulated_as_open() {
    // A motor moves a load through a spring with backlash; the law must hold the motor.
    let model = load(
        r#"
[inputs]
u = { unit = "N" }
[states]
x = { unit = "m" }
y = { unit = "m" }
[parameters]
m = { value = 1.0, unit = "kg" }
b = { value = 4.0, unit = "N s/m" }
k = { value = 300.0, unit = "N/m" }
gap = { value = 0.01, unit = "m" }
[equations]
motor = "m*x'' + b*x' + k*deadzone(x - y, gap) = u"
load = "m*y'' + b*y' - k*deadzone(x - y, gap) = 0"
"#,
    );
    let mut options = sized(&[("x", 0.2), ("x'", 1.0), ("y", 0.2), ("y'", 1.0)], 10.0);
    let open = Plant::of(&model, "u", &options).unwrap();
    let wanted = DesignOptions::new("x", &[0.0, 0.3], 2e-3);
    let error = design(&open, &Method::Lqr, &wanted).unwrap_err();
    assert!(error.to_string().contains("close_gaps"), "{error}");
    options.close_gaps = true;
    let plant = Plant::of(&model, "u", &options).unwrap();
    let closed: Vec<String> = plant.closed_gaps().iter().map(|d| d.term.to_string()).collect();
    assert_eq!(closed, ["deadzone(x - y, gap)", "deadzone(x - y, gap)"]);
    for method in [Method::Lqr, Method::Smc { lambda: 10.0, eta: 60.0, phi: 2.0 }] {
        let law = design(&plant, &method, &wanted).unwrap();
        let run = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
        let run = run.run(&Reference::step(0.3, 6.0)).unwrap();
        let m = run.metrics[0];
        println!("{} {m:?}", method.name());
        assert!(run.diverged.is_none() && m.final_error.abs() < 0.02, "{}: {m:?}", method.name());
    }
}
