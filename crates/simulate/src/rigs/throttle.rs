//! A spring-loaded plate with Coulomb friction that truly sticks.

/// A throttle: a plate on a return spring, driven by a torque u.
///
/// ```text
/// J θ'' + b θ' + c sign(θ') + k θ + k₃ θ³ = u + u₀ ,      at rest while |u + u₀ − k θ − k₃ θ³| ≤ c
/// ```
///
/// Coulomb friction as in H. Olsson et al., *Friction models and friction compensation*, Eur. J. Control 4, 1998. All
/// coefficients are public and may be changed between two steps, so that a machine that wears can be made.
///
/// ```
/// use greybox_simulate::rigs::Throttle;
/// let plate = Throttle { coulomb: 0.1, spring: 0.8, ..Throttle::NEW };
/// // Held by friction: the torque is not enough.
/// assert_eq!(plate.step([0.0, 0.0], 0.09, 0.01, 20), [0.0, 0.0]);
/// // A larger one moves it, and it comes to rest where friction holds the spring.
/// let mut state = [0.0, 0.0];
/// for _ in 0..1000 {
///     state = plate.step(state, 0.5, 0.01, 20);
/// }
/// assert!(state[1] == 0.0 && (0.5 - 0.8 * state[0]).abs() <= 0.1);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Throttle {
    /// Inertia J, kg·m².
    pub inertia: f64,
    /// Viscous friction b, N·m·s/rad.
    pub viscous: f64,
    /// Coulomb friction c, N·m.
    pub coulomb: f64,
    /// Stiffness k, N·m/rad.
    pub spring: f64,
    /// Stiffening k₃, N·m/rad³.
    pub stiffening: f64,
    /// A constant torque u₀, N·m.
    pub load: f64,
}

impl Throttle {
    /// One in good order.
    pub const NEW: Throttle =
        Throttle { inertia: 0.02, viscous: 0.02, coulomb: 0.1, spring: 0.8, stiffening: 0.0, load: 0.0 };

    /// Angle (rad) and its rate (rad/s) after `dt` seconds under a constant torque (N·m), by the midpoint rule in `substeps`
    /// equal steps; where the plate stops within one, the rest of it is a step of its own.
    pub fn step(&self, [mut angle, mut rate]: [f64; 2], torque: f64, dt: f64, substeps: usize) -> [f64; 2] {
        let free = |a: f64, v: f64| {
            torque + self.load - self.spring * a - self.stiffening * a * a * a - self.viscous * v
        };
        for _ in 0..substeps {
            let mut left = dt / substeps as f64;
            while left > 0.0 {
                let push = free(angle, 0.0);
                if rate == 0.0 && push.abs() <= self.coulomb {
                    break;
                }
                let way = if rate == 0.0 { push.signum() } else { rate.signum() };
                let acceleration = |a: f64, v: f64| (free(a, v) - way * self.coulomb) / self.inertia;
                let middle = rate + 0.5 * left * acceleration(angle, rate);
                let next = rate + left * acceleration(angle + 0.5 * left * rate, middle);
                if next * way < 0.0 {
                    let taken = left * rate / (rate - next);
                    angle += 0.5 * taken * rate;
                    rate = 0.0;
                    left -= taken;
                } else {
                    angle += 0.5 * left * (rate + next);
                    rate = next;
                    left = 0.0;
                }
            }
        }
        [angle, rate]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Free decay of a mass on a spring with Coulomb friction: every half swing is smaller by 2 c/k.
    #[test]
    fn every_half_swing_is_smaller_by_twice_the_friction() {
        let plate = Throttle { viscous: 0.0, coulomb: 0.04, ..Throttle::NEW };
        let (mut state, mut before) = ([1.0, 0.0], [1.0, 0.0]);
        let mut turns = Vec::new();
        for _ in 0..20_000 {
            state = plate.step(state, 0.0, 0.001, 20);
            if before[1] * state[1] < 0.0 || (state[1] == 0.0 && before[1] != 0.0) {
                turns.push(state[0].abs());
            }
            before = state;
        }
        // 1 − 0.1 n, until the spring no longer overcomes the friction at 0.05.
        assert!((9..=10).contains(&turns.len()), "{turns:?}");
        for (n, turn) in turns.iter().enumerate() {
            assert!((turn - (1.0 - 0.1 * (n + 1) as f64).abs()).abs() < 1e-4, "{n}: {turn}");
        }
        assert_eq!(state[1], 0.0);
    }
}
