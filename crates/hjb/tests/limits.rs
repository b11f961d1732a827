//! Inputs with limits: the cost, the law, and value functions held against known ones.

use greybox_hjb::{
    AdamaxOptions, Affine, Domain, Feedback, HjbError, InputRange, Linear, Monomials, Plant, PolicyOptions,
    Problem, adamax, design, design_within, policy_iteration,
};
use nalgebra::{DMatrix, dmatrix};

/// ∫ f over [a, b] by Simpson's rule.
fn quadrature(f: impl Fn(f64) -> f64, a: f64, b: f64) -> f64 {
    let n = 2000;
    let h = (b - a) / f64::from(n);
    let weight = |k| if k == 0 || k == n { 1.0 } else { 2.0 + 2.0 * f64::from(k % 2) };
    (0..=n).map(|k| weight(k) * f(a + h * f64::from(k))).sum::<f64>() * h / 3.0
}

#[test]
fn costs_are_the_integrals_of_their_slopes_and_laws_minimise_them() {
    let (mut of_cost, mut of_least, mut of_size) = (0.0f64, 0.0f64, 0.0f64);
    for (low, high, r) in [(-1.0, 1.0, 1.0), (-2.0, 2.0, 0.3), (-1.0, 4.0, 2.0), (-30.0, 0.5, 0.7)] {
        let range = InputRange::new(low, high).unwrap();
        let (m, h): (f64, f64) = (0.5 * (low + high), 0.5 * (high - low));
        // U′ as the definition has it.
        let slope =
            |v: f64| 2.0 * r * h * (1.0 - (m / h).powi(2)) * (((v - m) / h).atanh() - (-m / h).atanh());
        for share in [-0.97, -0.5, -0.1, -1e-3, 1e-3, 0.1, 0.5, 0.97] {
            let u = if share < 0.0 { -share * low } else { share * high };
            let exact = quadrature(slope, 0.0, u);
            of_cost = of_cost.max((range.cost(u, r) - exact).abs() / exact);
            // U′(u) + p = 0 at the law's u.
            let p = -slope(u);
            of_size = of_size.max((range.command(p, r) - u).abs() / u.abs());
            of_least = of_least.max((range.least(p, r) - (exact + p * u)).abs() / (p * u).abs());
        }
        // At the ends and beyond.
        for p in [1e3, 1e9, 1e300, f64::INFINITY] {
            assert!(range.command(p, r) >= low && range.command(-p, r) <= high);
        }
        assert!(range.command(1e9, r) < low * (1.0 - 1e-12) && range.command(-1e9, r) > high * (1.0 - 1e-12));
        assert!(range.cost(low, r).is_finite() && range.cost(high * 1.001, r).is_infinite());
        assert_eq!((range.command(0.0, r), range.least(0.0, r), range.cost(0.0, r)), (0.0, 0.0, 0.0));
        assert!(range.command(f64::NAN, r).is_nan() && range.cost(f64::NAN, r).is_nan());
    }
    println!("cost {of_cost:.1e}, command {of_size:.1e}, least {of_least:.1e} off");
    // The first and last as exact as the quadrature, the second as atanh near a limit.
    assert!(of_cost < 5e-11 && of_least < 3e-11 && of_size < 5e-12);
}

/// ẋ = a x + u with unit weights and |u| ≤ ū: V′ at x > 0, the root p > 0 of a x p + x² − 2 ū² ln cosh(p/(2ū)).
fn scalar_slope(a: f64, limit: f64, x: f64) -> f64 {
    let hamiltonian = |p: f64| a * x * p + x * x - 2.0 * limit * limit * (0.5 * p / limit).cosh().ln();
    let (mut low, mut high) = (0.0, 1.0);
    while hamiltonian(high) > 0.0 {
        high *= 2.0;
    }
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        if hamiltonian(middle) > 0.0 { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// The state and the cost ∫ (xᵀQx + U(u)) dt after `steps` of `dt` under a law, by Runge and Kutta.
fn run<const N: usize>(
    (plant, q, law): (&impl Plant, &DMatrix<f64>, &Feedback),
    x: [f64; N],
    (dt, steps): (f64, usize),
    mut see: impl FnMut(&[f64; N]),
) -> ([f64; N], f64) {
    let rate = |x: &[f64; N]| {
        let (mut f, mut g) = ([0.0; N], [0.0; N]);
        plant.drift(x, &mut f);
        plant.input(x, &mut g);
        let u = law.control(x, &g);
        let of_state: f64 = (0..N * N).map(|k| x[k / N] * q[(k / N, k % N)] * x[k % N]).sum();
        (std::array::from_fn(|i| f[i] + g[i] * u[0]), of_state + law.input_cost(&u))
    };
    let (mut x, mut cost) = (x, 0.0);
    for _ in 0..steps {
        let after = |k: [f64; N], h: f64| std::array::from_fn(|i| x[i] + h * k[i]);
        let (a, ca) = rate(&x);
        let (b, cb) = rate(&after(a, 0.5 * dt));
        let (c, cc) = rate(&after(b, 0.5 * dt));
        let (d, cd) = rate(&after(c, dt));
        x = std::array::from_fn(|i| x[i] + dt / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]));
        cost += dt / 6.0 * (ca + 2.0 * cb + 2.0 * cc + cd);
        see(&x);
    }
    (x, cost)
}

#[test]
fn scalar_plants_have_the_known_value_function() {
    let one = dmatrix![1.0];
    // Beyond |x| = ū nothing brings the unstable plant back.
    // Bounds twice what is measured, of the value, the law and the cost of the loop.
    for (a, limit, size, bounds) in [
        (-1.0, 0.5, 3.0, [3.4e-5, 1.9e-5, 1.7e-9]),
        (0.0, 0.5, 2.0, [6.2e-4, 3.2e-4, 5.8e-8]),
        (1.0, 1.0, 0.8, [1.5e-3, 7.6e-4, 9.2e-7]),
    ] {
        let plant = Linear { a: dmatrix![a], b: dmatrix![1.0] };
        let range = InputRange::new(-limit, limit).unwrap();
        let basis = Monomials::even(1, 12).unwrap();
        let domain = Domain::symmetric(&[size]).unwrap();
        let optimal = design_within(&plant, &one, &one, &[range], &domain, &basis).unwrap();
        let law = &optimal.feedback;
        let (mut of_value, mut of_law, mut of_cost) = (0.0f64, 0.0f64, 0.0f64);
        for k in 1..=20 {
            let x = size * f64::from(k) / 20.0;
            let exact = quadrature(|x| scalar_slope(a, limit, x), 1e-12, x);
            of_value = of_value.max((law.value(&[x]) - exact).abs() / exact);
            let command = -limit * (0.5 * scalar_slope(a, limit, x) / limit).tanh();
            of_law = of_law.max((law.control(&[x], &[1.0])[0] - command).abs() / limit);
            let (_, cost) = run((&plant, &one, law), [x], (0.01, 4000), |_| ());
            of_cost = of_cost.max((cost - exact).abs() / exact);
        }
        println!(
            "a = {a}: value {of_value:.1e}, law {of_law:.1e}, cost {of_cost:.1e} off; {} steps",
            optimal.policy.steps
        );
        assert!(of_value < bounds[0] && of_law < bounds[1] && of_cost < bounds[2]);
        assert!(optimal.verification.holds_everywhere(), "{:?}", optimal.verification);
    }
}

/// θ″ = sin θ − 0.1 θ′ + u.
fn pendulum() -> impl Plant {
    Affine {
        states: 2,
        inputs: 1,
        drift: |x: &[f64], f: &mut [f64]| f.copy_from_slice(&[x[1], x[0].sin() - 0.1 * x[1]]),
        input: |_: &[f64], g: &mut [f64]| g.copy_from_slice(&[0.0, 1.0]),
    }
}

#[test]
fn a_pendulum_costs_what_its_value_function_says() {
    let (plant, q, r) = (pendulum(), DMatrix::identity(2, 2), dmatrix![1.0]);
    for (low, high, bound) in [(-2.0, 2.0, 6e-4), (-1.5, 4.0, 1.8e-2)] {
        let range = InputRange::new(low, high).unwrap();
        let domain = Domain::symmetric(&[0.9, 0.9]).unwrap();
        let basis = Monomials::full(2, 8).unwrap();
        let optimal = design_within(&plant, &q, &r, &[range], &domain, &basis).unwrap();
        let law = &optimal.feedback;
        let (mut worst, mut largest) = (0.0f64, 0.0f64);
        for x in [[0.8, 0.0], [-0.8, 0.0], [0.5, 0.5], [-0.5, -0.5], [-0.6, 0.8], [0.6, -0.8]] {
            let (end, cost) = run((&plant, &q, law), x, (0.01, 3000), |x| {
                let u = law.control(x, &[0.0, 1.0])[0];
                assert!((low..=high).contains(&u));
                largest = largest.max(u.abs());
            });
            assert!(end.iter().all(|x| x.abs() < 1e-6), "{end:?}");
            worst = worst.max((cost - law.value(&x)).abs() / cost);
        }
        let v = &optimal.verification;
        println!(
            "pendulum {low} to {high}: cost {worst:.1e} off V, |u| up to {largest:.2}, residual {:.1e}",
            v.residual
        );
        assert!(worst < bound && largest > 0.8 * high.min(-low));
        assert!(v.holds_everywhere(), "{v:?}");
    }
}

/// How far x goes past zero, over the step of 1, and when it comes to stay within 2 % of it, s.
fn step_down(law: &Feedback, limit: f64) -> (f64, f64) {
    let (dt, mut x, mut overshoot, mut settling) = (0.005, [1.0, 0.0], 0.0f64, 0.0);
    for k in 1..=2000 {
        let u = law.control(&x, &[0.0, 1.0])[0].clamp(-limit, limit);
        x = [x[0] + dt * x[1] + 0.5 * dt * dt * u, x[1] + dt * u];
        overshoot = overshoot.max(-x[0]);
        settling = if x[0].abs() > 0.02 { f64::from(k) * dt } else { settling };
    }
    (overshoot, settling)
}

#[test]
fn a_mass_pushed_cheaply_brakes_in_time() {
    // ẍ = u within ±1, cost x² + r u²: what a clipped regulator does not know is that braking takes time.
    let plant = Linear { a: dmatrix![0.0, 1.0; 0.0, 0.0], b: dmatrix![0.0; 1.0] };
    let (q, domain) = (dmatrix![1.0, 0.0; 0.0, 0.0], Domain::symmetric(&[1.5, 1.5]).unwrap());
    let found = [0.1, 0.01, 0.001].map(|r| {
        let (r, basis) = (dmatrix![r], Monomials::even(2, 6).unwrap());
        let range = InputRange::new(-1.0, 1.0).unwrap();
        let within = design_within(&plant, &q, &r, &[range], &domain, &basis).unwrap();
        // The value function of a linear plant is quadratic: the regulator.
        let clipped = design(&plant, &q, &r, &domain, 2, false).unwrap();
        let (ours, theirs) = (step_down(&within.feedback, 1.0), step_down(&clipped.feedback, 1.0));
        println!(
            "r = {}: overshoot {:.3}, settling {:.2} s; clipped {:.3}, {:.2} s; V falls at {} of {} points",
            r[0],
            ours.0,
            ours.1,
            theirs.0,
            theirs.1,
            within.verification.decreasing,
            within.verification.points
        );
        (ours, theirs)
    });
    // Where the limit hardly binds there is nothing to gain.
    let (ours, theirs) = found[0];
    assert!((ours.0 - theirs.0).abs() < 0.015 && (ours.1 - theirs.1).abs() < 0.1, "{ours:?} {theirs:?}");
    let (ours, theirs) = found[1];
    assert!(ours.0 < 0.04 && theirs.0 > 0.1 && ours.1 < theirs.1 - 0.25, "{ours:?} {theirs:?}");
    let (ours, theirs) = found[2];
    assert!(ours.0 < 0.07 && theirs.0 > 0.35 && ours.1 < 0.6 * theirs.1, "{ours:?} {theirs:?}");
}

#[test]
fn an_upright_pendulum_is_caught_from_no_farther() {
    let (plant, q, r, limit) = (pendulum(), DMatrix::identity(2, 2), dmatrix![1.0], 0.5);
    let domain = Domain::symmetric(&[0.4, 0.4]).unwrap();
    let range = InputRange::new(-limit, limit).unwrap();
    let regulator = design(&plant, &q, &r, &domain, 2, false).unwrap().feedback;
    // Of 15 × 15 starts up to three quarters of a radian and of a radian per second; the clipped regulator is a law
    // with a plant that clips.
    let clips = |x: &[f64], f: &mut [f64]| {
        let u = regulator.control(x, &[0.0, 1.0])[0].clamp(-limit, limit);
        f.copy_from_slice(&[x[1], x[0].sin() - 0.1 * x[1] + u]);
    };
    let clipped =
        Affine { states: 2, inputs: 1, drift: clips, input: |_: &[f64], g: &mut [f64]| g.fill(0.0) };
    let starts = Domain::symmetric(&[0.75, 0.75]).unwrap().grid(&[15, 15]).unwrap();
    let caught = |plant: &dyn Fn([f64; 2], &mut f64) -> [f64; 2]| {
        let comes_back = |x: &&Vec<f64>| {
            // A pendulum that fell and was swung up again is not caught.
            let mut farthest = 0.0;
            let end = plant([x[0], x[1]], &mut farthest);
            farthest < 1.5 && end.iter().all(|x| x.abs() < 1e-2)
        };
        starts.iter().filter(comes_back).count()
    };
    let steps = (0.03, 1000);
    let least = caught(&|x, far| run((&clipped, &q, &regulator), x, steps, |x| *far = far.max(x[0].abs())).0);
    let found = [4, 8].map(|degree| {
        let basis = Monomials::even(2, degree).unwrap();
        let law = design_within(&plant, &q, &r, &[range], &domain, &basis).unwrap().feedback;
        caught(&|x, far| run((&plant, &q, &law), x, steps, |x| *far = far.max(x[0].abs())).0)
    });
    println!("caught from {least} of 225 starts by the clipped regulator, from {found:?} by degrees 4 and 8");
    assert!(found[0] < least && found[1] <= least && 10 * found[1] > 9 * least, "{found:?} {least}");
}

#[test]
fn wide_limits_give_the_quadratic_law() {
    let (plant, q, r) = (pendulum(), DMatrix::identity(2, 2), dmatrix![0.7]);
    let domain = Domain::symmetric(&[1.0, 1.0]).unwrap();
    let basis = Monomials::even(2, 6).unwrap();
    let free = design(&plant, &q, &r, &domain, 6, false).unwrap().feedback;
    let mut last = f64::INFINITY;
    for limit in [1e1, 1e2, 1e3, 1e6] {
        let range = InputRange::new(-limit, limit).unwrap();
        let law = design_within(&plant, &q, &r, &[range], &domain, &basis).unwrap().feedback;
        let off = |x: &[f64]| (law.control(x, &[0.0, 1.0])[0] - free.control(x, &[0.0, 1.0])[0]).abs();
        let worst = domain.halton(200).unwrap().iter().map(|x| off(x)).fold(0.0, f64::max);
        println!("limit {limit:e}: {worst:.1e} from the quadratic law");
        // The law's next term is −p³/(24 r³ ū²).
        assert!(worst < 1.5e-2 * last || worst < 1e-9, "{limit}: {worst:e}");
        last = worst;
    }
    assert!(last < 1e-9);
    let none = design_within(&plant, &q, &r, &[InputRange::UNLIMITED], &domain, &basis).unwrap().feedback;
    assert_eq!(none.weights(), free.weights());
}

#[test]
fn inputs_have_limits_of_their_own_and_training_ends_where_policy_iteration_does() {
    // Two masses that do not know of each other, the first with limits: their laws are those of each alone.
    let both = Linear { a: dmatrix![-1.0, 0.0; 0.0, 0.5], b: dmatrix![1.0, 0.0; 0.0, 2.0] };
    let (q, r) = (DMatrix::identity(2, 2), dmatrix![0.4, 0.0; 0.0, 3.0]);
    let ranges = [InputRange::new(-0.5, 0.5).unwrap(), InputRange::UNLIMITED];
    let domain = Domain::symmetric(&[1.0, 1.0]).unwrap();
    let basis = Monomials::even(2, 6).unwrap();
    let optimal = design_within(&both, &q, &r, &ranges, &domain, &basis).unwrap();
    let one = Linear { a: dmatrix![-1.0], b: dmatrix![1.0] };
    let (domain1, basis1) = (Domain::symmetric(&[1.0]).unwrap(), Monomials::even(1, 6).unwrap());
    let alone = design_within(&one, &dmatrix![1.0], &dmatrix![0.4], &ranges[..1], &domain1, &basis1).unwrap();
    let free = design(&both, &q, &r, &domain, 2, false).unwrap().feedback;
    let (g, mut off) = ([1.0, 0.0, 0.0, 2.0], 0.0f64);
    for x in domain.halton(50).unwrap() {
        let u = optimal.feedback.control(&x, &g);
        let (first, second) = (alone.feedback.control(&x[..1], &[1.0])[0], free.control(&x, &g)[1]);
        off = off.max((u[0] - first).abs()).max((u[1] - second).abs());
        let cost = ranges[0].cost(u[0], 0.4) + 3.0 * u[1] * u[1];
        assert!((optimal.feedback.input_cost(&u) - cost).abs() < 1e-14);
    }
    println!("laws of both {off:.1e} from those of each");
    assert!(off < 1.3e-4);
    assert!(optimal.feedback.input_cost(&[0.0]).is_nan());
    let points = domain1.halton(100).unwrap();
    let problem = Problem::new(&one, &dmatrix![1.0], &dmatrix![0.4], basis1, &points).unwrap();
    let problem = problem.within(&ranges[..1]).unwrap();
    let fast = policy_iteration(&problem, &[1.0, 0.0, 0.0], PolicyOptions::default()).unwrap();
    let options = AdamaxOptions { rate: 0.02, iterations: 40_000, ..Default::default() };
    let trained = adamax(&problem, &[1.0, 0.0, 0.0], &options).unwrap();
    println!("training J {:.9e}, policy iteration {:.9e} in {} steps", trained.loss, fast.loss, fast.steps);
    assert!(trained.loss >= fast.loss * (1.0 - 1e-9) && trained.loss < fast.loss * (1.0 + 1e-3));
}

#[test]
fn ranges_that_are_none_are_refused() {
    for (low, high) in [
        (1.0, 2.0),
        (0.0, 1.0),
        (-1.0, 0.0),
        (1.0, -1.0),
        (f64::NAN, 1.0),
        (-1.0, f64::INFINITY),
        (f64::NEG_INFINITY, 1.0),
        (-f64::MAX, f64::MAX),
    ] {
        let error = InputRange::new(low, high).unwrap_err();
        assert!(matches!(error, HjbError::Range { .. }), "{error}");
    }
    assert_eq!(InputRange::new(f64::NEG_INFINITY, f64::INFINITY), Ok(InputRange::UNLIMITED));
    let plant = Linear { a: dmatrix![-1.0], b: dmatrix![1.0, 1.0] };
    let (q, coupled) = (dmatrix![1.0], dmatrix![2.0, 1.0; 1.0, 2.0]);
    let (domain, basis) = (Domain::symmetric(&[1.0]).unwrap(), Monomials::even(1, 4).unwrap());
    let range = InputRange::new(-1.0, 1.0).unwrap();
    let with = |ranges: &[InputRange]| design_within(&plant, &q, &coupled, ranges, &domain, &basis);
    assert_eq!(with(&[range, range]).unwrap_err(), HjbError::CoupledInputs);
    assert!(matches!(with(&[range]).unwrap_err(), HjbError::Size { found: 1, wanted: 2, .. }));
    assert!(with(&[InputRange::UNLIMITED; 2]).is_ok());
    let law = Feedback::new(basis, vec![1.0, 0.0], &coupled).unwrap();
    assert_eq!(law.within(&[range, range]).unwrap_err(), HjbError::CoupledInputs);
}
