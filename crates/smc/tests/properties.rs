//! What must hold for every controllable plant.

use greybox_smc::check::ClosedLoop;
use greybox_smc::{BoundaryLayer, Command, FlatOutput, Law, Rate, SmcError, Surface, Tangent, Target, sat};
use proptest::array::{uniform3, uniform4, uniform5};
use proptest::prelude::*;

fn product<const N: usize>(a: [[f64; N]; N], b: [[f64; N]; N]) -> [[f64; N]; N] {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..N).map(|k| a[i][k] * b[k][j]).sum()))
}

fn times<const N: usize>(m: [[f64; N]; N], v: [f64; N]) -> [f64; N] {
    std::array::from_fn(|i| (0..N).map(|j| m[i][j] * v[j]).sum())
}

/// T = (I + l)(I + u) with triangles of small entries, and its inverse: well conditioned coordinates.
fn coordinates<const N: usize>(entries: [[f64; N]; N]) -> ([[f64; N]; N], [[f64; N]; N]) {
    let unit = |i: usize, j: usize| if i == j { 1.0 } else { 0.0 };
    let (mut t, mut inverse) = ([[0.0; N]; N], [[0.0; N]; N]);
    for i in 0..N {
        (t[i][i], inverse[i][i]) = (1.0, 1.0);
    }
    // Elementary matrices I + m e_i e_jᵀ, whose inverses are known.
    for i in 0..N {
        for j in (0..N).filter(|&j| j != i) {
            let m = entries[i][j];
            let shear = |m: f64| {
                std::array::from_fn(|r| {
                    std::array::from_fn(|c| unit(r, c) + if (r, c) == (i, j) { m } else { 0.0 })
                })
            };
            t = product(shear(m), t);
            inverse = product(inverse, shear(-m));
        }
    }
    (t, inverse)
}

/// Coefficients of (s + λ)ᴺ⁻¹ (s + rate) by rising power, without the leading 1.
fn wanted<const N: usize>(lambda: f64, rate: f64) -> [f64; N] {
    let mut p = vec![1.0];
    for k in 0..N {
        let root = if k == 0 { rate } else { lambda };
        let mut next = vec![0.0; p.len() + 1];
        for (i, c) in p.iter().enumerate() {
            next[i] += root * c;
            next[i + 1] += c;
        }
        p = next;
    }
    std::array::from_fn(|i| p[i])
}

fn law<const N: usize>(tangent: &Tangent<N>, lambda: f64, layer: (f64, f64), rate: Rate) -> Option<Law<N>> {
    let flat = FlatOutput::new(tangent).ok().filter(|flat| flat.reciprocal_condition() > 1e-5)?;
    let (surface, layer) = (Surface::repeated(lambda).ok()?, BoundaryLayer::new(layer.0, layer.1).ok()?);
    Law::new(flat, surface, layer, f64::INFINITY, rate).ok()
}

/// The closed loop has the poles −λ (N − 1 times) and −η/φ: compared by coefficients, since a multiple pole is
/// itself known to the N-th root of the rounding error only.
fn has_the_wanted_poles<const N: usize>(
    tangent: Tangent<N>,
    lambda: f64,
    rate: f64,
) -> Result<(), TestCaseError> {
    for kind in [Rate::Chain, Rate::Model] {
        let Some(law) = law(&tangent, lambda, (3.0 * rate, 3.0), kind) else { return Ok(()) };
        let closed = ClosedLoop::new(tangent, law.gains(&tangent).unwrap()).unwrap();
        // Rounding errors are those of the entries of A − b K, which are large where control is hard.
        let size = closed.matrix().iter().flatten().fold(lambda.max(rate), |size, a| size.max(a.abs()));
        let expected = wanted::<N>(lambda, rate);
        for (k, found) in closed.characteristic().into_iter().enumerate() {
            let scale = size.powi((N - k) as i32);
            prop_assert!((found - expected[k]).abs() < 1e-11 * scale, "{kind:?} {k}: {found} {expected:?}");
        }
        for pole in closed.poles().unwrap() {
            let off = (pole.re + lambda).hypot(pole.im).min((pole.re + rate).hypot(pole.im));
            prop_assert!(off < 0.01 * size, "{pole}");
        }
    }
    Ok(())
}

fn entry() -> impl Strategy<Value = f64> {
    -3.0..3.0_f64
}

proptest! {
    #[test]
    fn three_states_get_their_poles(
        a in uniform3(uniform3(entry())), b in uniform3(entry()), lambda in 0.5..5.0_f64, rate in 0.5..20.0_f64,
    ) {
        has_the_wanted_poles(Tangent::new(a, b), lambda, rate)?;
    }

    #[test]
    fn four_states_get_their_poles(
        a in uniform4(uniform4(entry())), b in uniform4(entry()), lambda in 0.5..5.0_f64, rate in 0.5..20.0_f64,
    ) {
        has_the_wanted_poles(Tangent::new(a, b), lambda, rate)?;
    }

    #[test]
    fn five_states_get_their_poles(
        a in uniform5(uniform5(entry())), b in uniform5(entry()), lambda in 0.5..5.0_f64, rate in 0.5..20.0_f64,
    ) {
        has_the_wanted_poles(Tangent::new(a, b), lambda, rate)?;
    }

    /// In coordinates T x the law is another, and its command the same.
    #[test]
    fn the_command_does_not_depend_on_the_coordinates(
        a in uniform4(uniform4(entry())), b in uniform4(entry()), entries in uniform4(uniform4(-0.5..0.5_f64)),
        x in uniform4(entry()), f in uniform4(entry()), origin in uniform4(entry()), desired in uniform4(entry()),
    ) {
        let (t, inverse) = coordinates(entries);
        let here = Tangent::new(a, b);
        let there = Tangent::new(product(product(t, a), inverse), times(t, b));
        let target = Target { origin, desired, highest: 0.4 };
        let moved = Target { origin: times(t, origin), ..target };
        for rate in [Rate::Chain, Rate::Model] {
            let (Some(first), Some(second)) =
                (law(&here, 2.0, (20.0, 4.0), rate), law(&there, 2.0, (20.0, 4.0), rate)) else { continue };
            let one = first.step(&x, &f, &b, &target).unwrap();
            let other = second.step(&times(t, x), &times(t, f), &there.b, &moved).unwrap();
            let condition = first.flat().reciprocal_condition().min(second.flat().reciprocal_condition());
            prop_assume!(condition > 1e-3);
            let size = 1.0 + one.unlimited.abs() + one.surface.abs();
            prop_assert!((one.u - other.u).abs() < 1e-10 * size / condition, "{one:?} {other:?}");
            prop_assert!((one.surface - other.surface).abs() < 1e-10 * size / condition);
        }
    }

    /// Other units of the states, the input and time change the command into the other unit, and nothing else.
    #[test]
    fn the_command_does_not_depend_on_the_units(
        a in uniform4(uniform4(entry())), b in uniform4(entry()), powers in uniform4(-30..30_i32),
        input in -30..30_i32, time in -12..12_i32, x in uniform4(entry()), f in uniform4(entry()),
    ) {
        let two = |power: i32| 2_f64.powi(power);
        let here = Tangent::new(a, b);
        let (d, input, time) = (powers.map(two), two(input), two(time));
        let there: Tangent<4> = Tangent::new(
            std::array::from_fn(|i| std::array::from_fn(|j| a[i][j] * d[i] / d[j] / time)),
            std::array::from_fn(|i| b[i] * d[i] / input / time),
        );
        let Some(first) = law(&here, 2.0, (20.0, 4.0), Rate::Chain) else { return Ok(()) };
        prop_assume!(first.flat().reciprocal_condition() > 1e-3);
        // β = 1 makes η an input, and s an input times a time.
        let second = law(&there, 2.0 / time, (20.0 * input, 4.0 * input * time), Rate::Chain);
        prop_assert!(second.is_some(), "{:?}", FlatOutput::new(&there));
        let second = second.unwrap();
        let one = first.step(&x, &f, &b, &Target::rest([0.5; 4])).unwrap();
        let scaled = |v: [f64; 4], time: f64| -> [f64; 4] { std::array::from_fn(|i| v[i] * d[i] / time) };
        let target = Target::rest(scaled([0.5; 4], 1.0));
        let other = second.step(&scaled(x, 1.0), &scaled(f, time), &there.b, &target).unwrap();
        let condition = first.flat().reciprocal_condition().min(second.flat().reciprocal_condition());
        let size = 1.0 + one.unlimited.abs() + one.surface.abs();
        prop_assert!((one.u - other.u / input).abs() < 1e-10 * size / condition, "{one:?} {other:?}");
    }

    /// A mode that the input does not reach is found, in whatever coordinates it hides.
    #[test]
    fn a_hidden_uncontrollable_mode_is_found(
        a in uniform4(uniform4(entry())), b in uniform4(entry()), entries in uniform4(uniform4(-0.5..0.5_f64)),
    ) {
        let (mut a, mut b) = (a, b);
        a[3] = [0.0, 0.0, 0.0, a[3][3]];
        b[3] = 0.0;
        let (t, inverse) = coordinates(entries);
        let hidden = Tangent::new(product(product(t, a), inverse), times(t, b));
        let refused = FlatOutput::new(&hidden);
        prop_assert!(
            matches!(refused, Err(SmcError::NotControllable { .. } | SmcError::Unreached { .. })), "{refused:?}"
        );
    }

    /// y_f and its derivatives give the state back.
    #[test]
    fn the_state_follows_from_the_flat_output(
        a in uniform4(uniform4(entry())), b in uniform4(entry()), x in uniform4(entry()),
    ) {
        let Ok(flat) = FlatOutput::new(&Tangent::new(a, b)) else { return Ok(()) };
        prop_assume!(flat.reciprocal_condition() > 1e-5);
        let back = flat.state(&flat.coordinates(&x)).unwrap();
        for i in 0..4 {
            prop_assert!((back[i] - x[i]).abs() < 1e-9 / flat.reciprocal_condition());
        }
    }

    /// Routh's test and the poles decide alike.
    #[test]
    fn routh_agrees_with_the_poles(p in uniform4(-1.0..6.0_f64)) {
        let [c0, c1, c2, c3] = p;
        let companion =
            [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-c0, -c1, -c2, -c3]];
        let closed = ClosedLoop::new(Tangent::new(companion, [0.0; 4]), [0.0; 4]).unwrap();
        let rightmost = closed.poles().unwrap()[0].re;
        prop_assume!(rightmost.abs() > 1e-6);
        prop_assert_eq!(Surface::new([c0, c1, c2, c3, 1.0]).is_ok(), rightmost < 0.0);
        for (found, expected) in closed.characteristic().iter().zip(p) {
            prop_assert!((found - expected).abs() < 1e-12);
        }
    }

    /// The largest pole in z is the rate at which the held loop really grows or decays.
    #[test]
    fn the_spectral_radius_is_what_the_held_loop_does(
        a in uniform3(uniform3(entry())), b in uniform3(entry()), gains in uniform3(entry()), dt in 0.01..1.5_f64,
    ) {
        let closed = ClosedLoop::new(Tangent::new(a, b), gains).unwrap();
        let radius = closed.spectral_radius(dt).unwrap();
        // RK4 on short steps with the command held, the state renormalised after every sample.
        let rates = |x: [f64; 3], u: f64| -> [f64; 3] {
            let ax = times(a, x);
            std::array::from_fn(|i| ax[i] + b[i] * u)
        };
        let along = |x: [f64; 3], k: [f64; 3], h: f64| -> [f64; 3] { std::array::from_fn(|i| x[i] + h * k[i]) };
        let (mut x, mut growth, samples) = ([0.6, -0.5, 0.7], 0.0, 400);
        for sample in 0..samples {
            let u = -(gains[0] * x[0] + gains[1] * x[1] + gains[2] * x[2]);
            let h = dt / 40.0;
            for _ in 0..40 {
                let k1 = rates(x, u);
                let k2 = rates(along(x, k1, 0.5 * h), u);
                let k3 = rates(along(x, k2, 0.5 * h), u);
                let k4 = rates(along(x, k3, h), u);
                x = std::array::from_fn(|i| x[i] + h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]));
            }
            let size = x.iter().map(|x| x * x).sum::<f64>().sqrt();
            prop_assume!(size > 0.0);
            x = x.map(|x| x / size);
            // The start decides the first samples.
            if sample >= samples / 2 {
                growth += size.ln();
            }
        }
        let measured = (growth / f64::from(samples / 2)).exp();
        prop_assert!((measured / radius - 1.0).abs() < 0.05, "{measured} {radius}");
    }

    /// Whatever the numbers: a finite command within the limit, or a fault.
    #[test]
    fn a_command_is_always_finite_and_within_the_limit(
        x in uniform3(any::<f64>()), f in uniform3(any::<f64>()), g in uniform3(any::<f64>()),
        origin in uniform3(any::<f64>()), desired in uniform3(any::<f64>()), highest in any::<f64>(),
    ) {
        let plant = Tangent::new([[0.0, 1.0, 0.0], [-2.0, -0.1, 1.0], [0.0, 0.0, -4.0]], [0.0, 0.0, 4.0]);
        let layer = BoundaryLayer::new(50.0, 2.0).unwrap();
        let flat = FlatOutput::new(&plant).unwrap();
        for rate in [Rate::Chain, Rate::Model] {
            let law = Law::new(flat, Surface::repeated(3.0).unwrap(), layer, 7.0, rate).unwrap();
            for target in [Target { origin, desired, highest }, Target::rest([1.0, 2.0, 2.0])] {
                for g in [g, plant.b] {
                    for f in [f, [0.0; 3]] {
                        if let Ok(Command { u, unlimited, surface, saturated }) = law.step(&x, &f, &g, &target) {
                            prop_assert!(u.abs() <= 7.0 && unlimited.is_finite() && surface.is_finite());
                            prop_assert_eq!(saturated, unlimited.abs() > 7.0);
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn the_saturation_is_odd_rising_and_bounded(s in any::<f64>(), r in any::<f64>(), phi in 1e-9..1e9_f64) {
        prop_assume!(!s.is_nan() && !r.is_nan());
        prop_assert_eq!(sat(-s, phi), -sat(s, phi));
        prop_assert!(sat(s, phi).abs() <= 1.0);
        prop_assert!(s > r || sat(s, phi) <= sat(r, phi));
        prop_assert!(s.abs() < phi || sat(s, phi) == s.signum());
    }
}
