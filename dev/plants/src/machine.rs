//! The true machines: equations of motion written out by hand, and their solution.
//!
//! `M(q) q'' + h = 0` with up to two coordinates, some states more, and dry friction as a set-valued force:
//! a sliding contact keeps its direction until its velocity passes zero, a sticking one holds with the
//! force that keeps it still until that force exceeds the static level. Both instants are located, so that
//! between them a fixed-step Runge–Kutta method of fourth order solves a smooth equation. Nothing here is
//! shared with greybox's own simulator.

use crate::kind::Kind;

/// Runge–Kutta steps in one sampling period.
pub const SUBSTEPS: usize = 20;
/// Numbers in a state: two coordinates, their rates, the rest.
const WIDTH: usize = 12;
/// Where the states beyond coordinates and rates begin.
const EXTRA: usize = 4;

type State = [f64; WIDTH];

/// A family of machines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Family {
    /// `J θ'' + B θ' = kt u`.
    Servo,
    /// `m x'' + c x' + k x = f`.
    Oscillator,
    /// `J φ'' + b φ' + mgl sin φ = τ`.
    Pendulum,
    /// Motor and load over a spring.
    TwoMass,
    /// Hub angle and deflection of the link.
    FlexibleLink,
    /// A shaft and a coil whose current no channel measures.
    DcMotor,
    /// Body and wheel on a road.
    QuarterCar,
    /// `m x'' + c x' + k x + k3 x³ = f`.
    Duffing,
    /// Two axes, each with its drive.
    Table,
}

/// All families.
pub const FAMILIES: [Family; 9] = [
    Family::Servo,
    Family::Oscillator,
    Family::Pendulum,
    Family::TwoMass,
    Family::FlexibleLink,
    Family::DcMotor,
    Family::QuarterCar,
    Family::Duffing,
    Family::Table,
];

/// An effect with its parameters, at its place.
#[derive(Debug, Clone, PartialEq)]
pub struct Effect {
    /// What it is.
    pub kind: Kind,
    /// The place (for forces), the input or the channel on which it acts.
    pub at: usize,
    /// Values in the order of [`Kind::parameters`].
    pub p: [f64; 3],
    /// For a drift: which parameter of the machine. For a coupling: 1 when it acts in both equations.
    pub which: usize,
}

/// A motion `d` of the machine and the equations in which a force along it enters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Weights of the force in the equations of the coordinates.
    pub w: [f64; 2],
    /// `d = c·q`.
    pub c: [f64; 2],
}

/// A machine: family, parameters in the order of [`Family::parameters`], and its effects.
#[derive(Debug, Clone)]
pub struct Machine {
    /// Its equations.
    pub family: Family,
    /// A parameter of zero stands for a term that is not there.
    pub p: Vec<f64>,
    /// What the nominal model leaves out.
    pub effects: Vec<Effect>,
}

/// What drives a machine.
pub enum Drive<'a> {
    /// Values of each input at the samples.
    Samples(&'a [Vec<f64>]),
    /// A controller that is given the sample's number and the measured coordinates (before noise).
    Controller(&'a mut dyn FnMut(usize, &[f64]) -> [f64; 2]),
}

/// What happens between samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hold {
    /// The last sample.
    Zero,
    /// A straight line from sample to sample.
    Linear,
}

/// A solution at the samples.
#[derive(Debug, Clone)]
pub struct Run {
    /// What sensors without noise show of each coordinate.
    pub y: Vec<Vec<f64>>,
    /// Coordinates.
    pub q: Vec<Vec<f64>>,
    /// Their rates.
    pub v: Vec<Vec<f64>>,
    /// Inputs as commanded.
    pub u: Vec<Vec<f64>>,
    /// Whether all is finite.
    pub finite: bool,
}

/// Time as the number of a step and the part of it that has passed.
#[derive(Clone, Copy)]
struct Clock {
    step: usize,
    inside: f64,
    h: f64,
}

impl Clock {
    fn seconds(self) -> f64 {
        (self.step as f64 + self.inside) * self.h
    }
}

struct Past<'a> {
    u: &'a [Vec<f64>],
    hold: Hold,
    substeps: usize,
    /// Coordinates and rates at the beginnings of the steps.
    track: &'a [[f64; 4]],
}

impl Past<'_> {
    /// An input `back` seconds ago, its first value before the start.
    fn input(&self, i: usize, clock: Clock, back: f64) -> f64 {
        let u = &self.u[i];
        let steps = back / clock.h;
        let whole = (steps - 1e-6).ceil().max(0.0);
        let ahead = whole - steps;
        // A delay of whole steps keeps the left limit at the end of a step.
        let (step, inside) = if ahead < 1e-6 {
            (clock.step as i64 - whole as i64, clock.inside)
        } else {
            let place = clock.step as f64 + clock.inside - steps;
            (place.floor() as i64, place - place.floor())
        };
        if step < 0 {
            return u[0];
        }
        let n = self.substeps as i64;
        let (k, s) = ((step / n) as usize, ((step % n) as f64 + inside) / n as f64);
        match self.hold {
            Hold::Zero => u[k.min(u.len() - 1)],
            Hold::Linear => {
                let (a, b) = (u[k.min(u.len() - 1)], u[(k + 1).min(u.len() - 1)]);
                a + s * (b - a)
            }
        }
    }

    /// Coordinates `back` seconds ago (cubic between steps), the first ones before the start.
    fn coordinates(&self, clock: Clock, back: f64) -> [f64; 2] {
        let place = clock.step as f64 + clock.inside - back / clock.h;
        if place <= 0.0 {
            return [self.track[0][0], self.track[0][1]];
        }
        let last = self.track.len() - 1;
        let k = (place.floor() as usize).min(last.saturating_sub(1));
        let s = place - k as f64;
        let (a, b) = (self.track[k], self.track[(k + 1).min(last)]);
        let (s2, s3) = (s * s, s * s * s);
        let (h00, h01) = (2.0 * s3 - 3.0 * s2 + 1.0, 3.0 * s2 - 2.0 * s3);
        let (h10, h11) = (s3 - 2.0 * s2 + s, s3 - s2);
        std::array::from_fn(|i| h00 * a[i] + h01 * b[i] + clock.h * (h10 * a[i + 2] + h11 * b[i + 2]))
    }
}

/// `deadzone` of the model language.
fn dead_zone(x: f64, gap: f64) -> f64 {
    if x.abs() <= gap { 0.0 } else { x - gap * x.signum() }
}

/// Mass matrix, the rest of the equations, and rates of the further states.
struct Terms {
    m: [[f64; 2]; 2],
    h: [f64; 2],
    extra: [f64; WIDTH - EXTRA],
    /// Levels of dry friction of each contact for motion forwards and backwards, at the present speed.
    levels: [[f64; 2]; 4],
}

impl Family {
    /// Number of coordinates.
    pub fn coordinates(self) -> usize {
        match self {
            Family::TwoMass | Family::FlexibleLink | Family::QuarterCar | Family::Table => 2,
            _ => 1,
        }
    }

    /// Number of inputs.
    pub fn inputs(self) -> usize {
        if self == Family::Table { 2 } else { 1 }
    }

    /// The motions along which a force may act.
    pub fn places(self) -> &'static [Place] {
        const OWN: Place = Place { w: [1.0, 0.0], c: [1.0, 0.0] };
        const SECOND: Place = Place { w: [0.0, 1.0], c: [0.0, 1.0] };
        const BETWEEN: Place = Place { w: [1.0, -1.0], c: [1.0, -1.0] };
        match self {
            Family::TwoMass => &[OWN, SECOND, BETWEEN],
            Family::FlexibleLink => &[OWN, Place { w: [-1.0, 1.0], c: [0.0, 1.0] }],
            Family::QuarterCar => &[BETWEEN, OWN],
            Family::Table => &[OWN, SECOND],
            _ => &[OWN],
        }
    }

    /// The place of the elastic term in which a gap or a delay may stand.
    pub fn elastic(self) -> Option<usize> {
        match self {
            Family::Oscillator | Family::Duffing | Family::QuarterCar => Some(0),
            Family::TwoMass => Some(2),
            Family::FlexibleLink | Family::Table => Some(1),
            _ => None,
        }
    }
}

impl Machine {
    fn place(&self, effect: &Effect) -> Place {
        self.family.places()[effect.at]
    }

    /// Where the further states of an effect begin.
    fn slot(&self, index: usize) -> usize {
        let mut slot = usize::from(self.family == Family::DcMotor);
        for e in &self.effects[..index] {
            slot += states_of(e.kind);
        }
        slot
    }

    fn motion(&self, effect: &Effect, y: &State) -> (f64, f64) {
        let c = self.place(effect).c;
        (c[0] * y[0] + c[1] * y[1], c[0] * y[2] + c[1] * y[3])
    }

    /// The input as it reaches the machine.
    fn effective_input(&self, i: usize, clock: Clock, y: &State, past: &Past<'_>) -> f64 {
        let delay =
            self.effects.iter().find(|e| e.kind == Kind::InputDelay && e.at == i).map_or(0.0, |e| e.p[0]);
        let mut u = past.input(i, clock, delay);
        for (index, e) in self.effects.iter().enumerate().filter(|(_, e)| e.kind.on_input() && e.at == i) {
            let own = EXTRA + self.slot(index);
            u = match e.kind {
                Kind::InputOffset => u + e.p[0],
                Kind::InputSaturation => u.clamp(-e.p[0], e.p[0]),
                Kind::InputDeadZone => dead_zone(u, e.p[0]),
                Kind::ActuatorLag => y[own],
                Kind::TiringActuator => u / (1.0 + e.p[0] * y[own]),
                _ => u,
            };
        }
        u
    }

    /// Everything but dry friction's own force.
    fn terms(&self, clock: Clock, y: &State, past: &Past<'_>) -> Terms {
        let t = clock.seconds();
        let mut p = [0.0; 8];
        p[..self.p.len()].copy_from_slice(&self.p);
        for e in self.effects.iter().filter(|e| e.kind == Kind::ParameterDrift) {
            p[e.which] *= 1.0 + e.p[0] * t;
        }
        let u: [f64; 2] = std::array::from_fn(|i| {
            if i < self.family.inputs() { self.effective_input(i, clock, y, past) } else { 0.0 }
        });
        let (q, v) = ([y[0], y[1]], [y[2], y[3]]);
        let mut elastic = self.family.elastic().map_or(0.0, |i| {
            let c = self.family.places()[i].c;
            c[0] * q[0] + c[1] * q[1]
        });
        for e in &self.effects {
            match e.kind {
                Kind::DeadZone => elastic = dead_zone(elastic, e.p[0]),
                Kind::FeedbackDelay => {
                    let (c, then) = (self.place(e).c, past.coordinates(clock, e.p[0]));
                    elastic = c[0] * then[0] + c[1] * then[1];
                }
                _ => {}
            }
        }
        let mut extra = [0.0; WIDTH - EXTRA];
        let (mut m, mut h) = self.nominal(&p, q, v, u, elastic, y, &mut extra);
        let mut levels = [[0.0; 2]; 4];
        let mut contact = 0;
        for (index, e) in self.effects.iter().enumerate() {
            let slot = self.slot(index);
            let a = &e.p;
            if e.kind == Kind::ActuatorLag {
                extra[slot] = (past.input(e.at, clock, 0.0) - y[EXTRA + slot]) / a[0];
                continue;
            }
            if e.kind == Kind::TiringActuator {
                extra[slot] = (past.input(e.at, clock, 0.0).abs() - y[EXTRA + slot]) / a[1];
                continue;
            }
            if e.kind.on_input() || e.kind.on_measurement() {
                continue;
            }
            let place = self.place(e);
            let (d, r) = self.motion(e, y);
            if e.kind == Kind::AgeingFriction {
                extra[slot] = (r.abs() - y[EXTRA + slot]) / a[2];
            }
            if let Some(pair) = self.friction_levels(index, d, r, &p, u, elastic, y) {
                levels[contact] = pair;
                contact += 1;
                continue;
            }
            let z = y[EXTRA + slot];
            let force = match e.kind {
                Kind::ViscousFriction => a[0] * r,
                Kind::PreslidingFriction => {
                    extra[slot] = r - a[0] / a[1] * r.abs() * z;
                    a[0] * z
                }
                Kind::QuadraticDrag => a[0] * r * r.abs(),
                Kind::LinearStiffness => a[0] * d,
                Kind::QuadraticStiffness => a[0] * d * d,
                Kind::CubicStiffness => a[0] * d * d * d,
                Kind::EndStop => a[0] * (d - a[1]).max(0.0),
                Kind::BoucWenHysteresis => {
                    extra[slot] = r - a[1] * r.abs() * z - a[2] * r * z.abs();
                    a[0] * z
                }
                Kind::Gravity => a[0] * d.sin(),
                Kind::Cogging => a[0] * (a[1] * d + a[2]).sin(),
                Kind::PositionDependentInertia => {
                    let own = a[0] * (a[1] * d).cos();
                    (0..2).for_each(|i| (0..2).for_each(|j| m[i][j] += place.w[i] * place.c[j] * own));
                    -0.5 * a[0] * a[1] * (a[1] * d).sin() * r * r
                }
                Kind::Coupling => {
                    // In the equation of its own coordinate, of the other coordinate; or in both.
                    let (own, other) = (e.at, 1 - e.at);
                    h[own] += a[0] * q[other] + a[1] * v[other];
                    m[own][other] += a[2];
                    if e.which == 1 {
                        h[other] += a[0] * q[own] + a[1] * v[own];
                        m[other][own] += a[2];
                    }
                    0.0
                }
                Kind::UnmodeledResonance => {
                    let back = a[1] * (d - z) + a[2] * (r - y[EXTRA + slot + 1]);
                    extra[slot] = y[EXTRA + slot + 1];
                    extra[slot + 1] = back / a[0];
                    back
                }
                Kind::ConstantOffset => a[0],
                Kind::PeriodicDisturbance => a[0] * (std::f64::consts::TAU * a[1] * t + a[2]).sin(),
                // By the step's number: t0 is the beginning of a step.
                Kind::StepDisturbance if clock.step as f64 * clock.h > a[1] - 0.5 * clock.h => a[0],
                Kind::DisplacementDamping => a[0] * d * d * r,
                Kind::SineOfPower => a[0] * (a[1] * d * r).sin(),
                Kind::BreathingQuadratic => a[0] * (1.0 + (std::f64::consts::TAU * a[1] * t).cos()) * d * d,
                Kind::ProductCoupling => a[0] * q[0] * q[1],
                Kind::QuinticStiffness => a[0] * d.powi(5),
                Kind::ParametricExcitation => a[0] * (std::f64::consts::TAU * a[1] * t).cos() * d,
                Kind::EddyBrake => a[0] * r / (1.0 + (r / a[1]).powi(2)),
                Kind::MaxwellElement => {
                    extra[slot] = (d - z) / a[1];
                    a[0] * (d - z)
                }
                Kind::OneWayDamper => a[0] * r.max(0.0),
                Kind::PowerDrag => a[0] * r.abs().powf(1.5).copysign(r),
                Kind::LockingSpring => a[0] * (d / a[1]).sinh(),
                _ => 0.0,
            };
            (0..2).for_each(|i| h[i] += place.w[i] * force);
        }
        if self.family.coordinates() == 1 {
            m[1] = [0.0, 1.0];
            m[0][1] = 0.0;
            h[1] = 0.0;
        }
        Terms { m, h, extra, levels }
    }

    /// The family's own equations: mass matrix and the rest on the left side.
    fn nominal(
        &self,
        p: &[f64; 8],
        q: [f64; 2],
        v: [f64; 2],
        u: [f64; 2],
        elastic: f64,
        y: &State,
        extra: &mut [f64; WIDTH - EXTRA],
    ) -> ([[f64; 2]; 2], [f64; 2]) {
        let diagonal = |a: f64, b: f64| [[a, 0.0], [0.0, b]];
        match self.family {
            Family::Servo => (diagonal(p[0], 1.0), [p[1] * v[0] - p[2] * u[0], 0.0]),
            Family::Oscillator => (diagonal(p[0], 1.0), [p[1] * v[0] + p[2] * elastic - u[0], 0.0]),
            Family::Pendulum => (diagonal(p[0], 1.0), [p[1] * v[0] + p[2] * q[0].sin() - u[0], 0.0]),
            Family::TwoMass => {
                let spring = p[2] * elastic + p[3] * (v[0] - v[1]);
                (diagonal(p[0], p[4]), [p[1] * v[0] + spring - p[6] * u[0], p[5] * v[1] - spring])
            }
            Family::FlexibleLink => (
                [[p[0], 0.0], [p[3], p[3]]],
                [p[1] * v[0] - p[2] * elastic - p[5] * u[0], p[4] * v[1] + p[2] * elastic],
            ),
            Family::DcMotor => {
                let i = y[EXTRA];
                extra[0] = (u[0] - p[4] * i - p[2] * v[0]) / p[3];
                (diagonal(p[0], 1.0), [p[1] * v[0] - p[2] * i, 0.0])
            }
            Family::QuarterCar => {
                let spring = p[1] * (v[0] - v[1]) + p[2] * elastic;
                (diagonal(p[0], p[3]), [spring, p[4] * (q[1] - u[0]) - spring])
            }
            Family::Duffing => {
                (diagonal(p[0], 1.0), [p[1] * v[0] + p[2] * elastic + p[3] * q[0].powi(3) - u[0], 0.0])
            }
            Family::Table => {
                (diagonal(p[0], p[2]), [p[1] * v[0] - p[5] * u[0], p[3] * v[1] + p[4] * elastic - u[1]])
            }
        }
    }

    /// What the family's own equations lack for the accelerations `a`: the force on their left side.
    pub fn missing_force(&self, q: [f64; 2], v: [f64; 2], a: [f64; 2], u: &[f64]) -> [f64; 2] {
        let mut p = [0.0; 8];
        p[..self.p.len()].copy_from_slice(&self.p);
        let elastic = self.family.elastic().map_or(0.0, |i| {
            let c = self.family.places()[i].c;
            c[0] * q[0] + c[1] * q[1]
        });
        let u = [u.first().copied().unwrap_or(0.0), u.get(1).copied().unwrap_or(0.0)];
        let (m, h) = self.nominal(&p, q, v, u, elastic, &[0.0; WIDTH], &mut [0.0; WIDTH - EXTRA]);
        std::array::from_fn(|i| -(m[i][0] * a[0] + m[i][1] * a[1] + h[i]))
    }

    /// Dry friction forwards and backwards at the rate `r`; `None` for an effect of another nature.
    fn friction_levels(
        &self,
        index: usize,
        d: f64,
        r: f64,
        p: &[f64; 8],
        u: [f64; 2],
        elastic: f64,
        y: &State,
    ) -> Option<[f64; 2]> {
        let e = &self.effects[index];
        let a = &e.p;
        match e.kind {
            Kind::CoulombFriction => Some([a[0]; 2]),
            Kind::AsymmetricCoulombFriction => Some([a[0], a[1]]),
            Kind::StribeckFriction => Some([a[0] + (a[1] - a[0]) * (-(r / a[2]).powi(2)).exp(); 2]),
            Kind::LoadDependentFriction => {
                let load = match self.family {
                    Family::TwoMass if e.at == 1 => p[2] * elastic,
                    Family::TwoMass => p[6] * u[0],
                    Family::DcMotor => p[2] * y[EXTRA],
                    Family::Servo => p[2] * u[0],
                    Family::FlexibleLink | Family::Table => p[5] * u[0],
                    _ => u[0],
                };
                Some([a[0] * load.abs(); 2])
            }
            Kind::PositionFriction => Some([a[0] * d * d; 2]),
            Kind::AgeingFriction => Some([a[0] / (1.0 + y[EXTRA + self.slot(index)] / a[1]); 2]),
            _ => None,
        }
    }

    /// Places of the contacts with dry friction.
    fn contacts(&self) -> Vec<Place> {
        self.effects.iter().filter(|e| is_dry(e.kind)).map(|e| self.place(e)).collect()
    }

    /// Rates of the state with every contact sliding (±1) or sticking (0) as said, and the contacts' forces.
    fn rates(
        &self,
        clock: Clock,
        y: &State,
        contacts: &[Place],
        modes: &[i8; 4],
        past: &Past<'_>,
    ) -> (State, [f64; 4], [[f64; 2]; 4]) {
        let terms = self.terms(clock, y, past);
        let mut h = terms.h;
        let mut forces = [0.0; 4];
        for (i, place) in contacts.iter().enumerate() {
            forces[i] = match modes[i] {
                0 => 0.0,
                m if m > 0 => terms.levels[i][0],
                _ => -terms.levels[i][1],
            };
            (0..2).for_each(|e| h[e] += place.w[e] * forces[i]);
        }
        let m = terms.m;
        let det = m[0][0] * m[1][1] - m[0][1] * m[1][0];
        let solve =
            |b: [f64; 2]| [(m[1][1] * b[0] - m[0][1] * b[1]) / det, (m[0][0] * b[1] - m[1][0] * b[0]) / det];
        let free = solve(h);
        let mut acceleration = [-free[0], -free[1]];
        // Forces that keep the sticking contacts still: (c_i·M⁻¹w_j) λ_j = −c_i·M⁻¹h.
        let stuck: Vec<usize> = (0..contacts.len()).filter(|&i| modes[i] == 0).collect();
        let dot = |a: [f64; 2], b: [f64; 2]| a[0] * b[0] + a[1] * b[1];
        match stuck[..] {
            [] => {}
            [i] => {
                let along = solve(contacts[i].w);
                let lambda = dot(contacts[i].c, acceleration) / dot(contacts[i].c, along);
                forces[i] = lambda;
                (0..2).for_each(|e| acceleration[e] -= along[e] * lambda);
            }
            [i, j, ..] => {
                let (ai, aj) = (solve(contacts[i].w), solve(contacts[j].w));
                let k = [
                    [dot(contacts[i].c, ai), dot(contacts[i].c, aj)],
                    [dot(contacts[j].c, ai), dot(contacts[j].c, aj)],
                ];
                let b = [dot(contacts[i].c, acceleration), dot(contacts[j].c, acceleration)];
                let d = k[0][0] * k[1][1] - k[0][1] * k[1][0];
                let l = [(k[1][1] * b[0] - k[0][1] * b[1]) / d, (k[0][0] * b[1] - k[1][0] * b[0]) / d];
                (forces[i], forces[j]) = (l[0], l[1]);
                (0..2).for_each(|e| acceleration[e] -= ai[e] * l[0] + aj[e] * l[1]);
            }
        }
        let mut dy = [0.0; WIDTH];
        (dy[0], dy[1], dy[2], dy[3]) = (y[2], y[3], acceleration[0], acceleration[1]);
        dy[EXTRA..].copy_from_slice(&terms.extra);
        (dy, forces, terms.levels)
    }

    /// One Runge–Kutta step of length `size·h` from `clock`.
    fn leap(
        &self,
        clock: Clock,
        size: f64,
        y: &State,
        contacts: &[Place],
        modes: &[i8; 4],
        past: &Past<'_>,
    ) -> State {
        let at = |part: f64| Clock { inside: clock.inside + part * size, ..clock };
        let f = |clock: Clock, y: &State| self.rates(clock, y, contacts, modes, past).0;
        let h = size * clock.h;
        let ahead = |k: &State, part: f64| std::array::from_fn(|i| y[i] + part * h * k[i]);
        let k1 = f(clock, y);
        let k2 = f(at(0.5), &ahead(&k1, 0.5));
        let k3 = f(at(0.5), &ahead(&k2, 0.5));
        let k4 = f(at(1.0), &ahead(&k3, 1.0));
        std::array::from_fn(|i| y[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]))
    }

    /// By how much each contact leaves its mode, positive when it does.
    fn leaving(
        &self,
        clock: Clock,
        y: &State,
        contacts: &[Place],
        modes: &[i8; 4],
        past: &Past<'_>,
    ) -> [f64; 4] {
        let (_, forces, levels) = self.rates(clock, y, contacts, modes, past);
        let mut out = [-1.0; 4];
        for (i, place) in contacts.iter().enumerate() {
            let rate = place.c[0] * y[2] + place.c[1] * y[3];
            out[i] = match modes[i] {
                0 => (forces[i] - levels[i][0]).max(-levels[i][1] - forces[i]),
                m => -f64::from(m) * rate,
            };
        }
        out
    }

    /// Mode of contact `i` at rest: sticking, or sliding where the force that would hold it is too large.
    fn mode_at_rest(
        &self,
        i: usize,
        clock: Clock,
        y: &State,
        contacts: &[Place],
        modes: &[i8; 4],
        past: &Past<'_>,
    ) -> i8 {
        let mut held = *modes;
        held[i] = 0;
        let (_, forces, levels) = self.rates(clock, y, contacts, &held, past);
        if forces[i] > levels[i][0] {
            1
        } else if forces[i] < -levels[i][1] {
            -1
        } else {
            0
        }
    }

    /// One whole step: smooth where no contact changes, else piece by piece between the changes.
    fn step(
        &self,
        clock: Clock,
        y: &State,
        contacts: &[Place],
        modes: &mut [i8; 4],
        past: &Past<'_>,
    ) -> State {
        if contacts.is_empty() {
            return self.leap(clock, 1.0, y, contacts, modes, past);
        }
        let (mut now, mut y) = (clock, *y);
        for _ in 0..12 {
            let size = 1.0 - now.inside;
            let after = |size: f64| {
                let y1 = self.leap(now, size, &y, contacts, modes, past);
                let there = Clock { inside: now.inside + size, ..now };
                (y1, self.leaving(there, &y1, contacts, modes, past))
            };
            let first = |out: &[f64; 4]| (0..contacts.len()).any(|i| out[i] > 0.0);
            let (y1, out) = after(size);
            if !first(&out) {
                return y1;
            }
            // The first change lies inside: bisection on the length of the piece.
            let (mut low, mut high) = (0.0, size);
            for _ in 0..44 {
                let middle = 0.5 * (low + high);
                if first(&after(middle).1) { high = middle } else { low = middle }
            }
            let (y1, out) = after(high);
            y = y1;
            now.inside += high;
            for i in 0..contacts.len() {
                if out[i] <= 0.0 {
                    continue;
                }
                let c = contacts[i].c;
                let rate = c[0] * y[2] + c[1] * y[3];
                let size = c[0] * c[0] + c[1] * c[1];
                (0..2).for_each(|e| y[2 + e] -= c[e] * rate / size);
                modes[i] = self.mode_at_rest(i, now, &y, contacts, modes, past);
            }
            if now.inside >= 1.0 {
                return y;
            }
        }
        // Changes that pile up mean rest.
        let size = 1.0 - now.inside;
        self.leap(now, size, &y, contacts, modes, past)
    }

    /// What sensors without noise show.
    fn sensed(&self, clock: Clock, q: [f64; 2], past: &Past<'_>) -> [f64; 2] {
        let mut y = q;
        for e in &self.effects {
            match e.kind {
                Kind::SensorDelay => y[e.at] = past.coordinates(clock, e.p[0])[e.at],
                Kind::SensorOffset => y[e.at] += e.p[0],
                _ => {}
            }
        }
        y
    }

    /// Solves `samples` samples, `dt` apart, from `start` (coordinates, then rates), in `substeps` steps per
    /// sample.
    pub fn run(
        &self,
        start: [f64; 4],
        samples: usize,
        dt: f64,
        hold: Hold,
        mut drive: Drive<'_>,
        substeps: usize,
    ) -> Run {
        let (n, inputs, h) = (self.family.coordinates(), self.family.inputs(), dt / substeps as f64);
        let contacts = self.contacts();
        let mut u: Vec<Vec<f64>> = match &drive {
            Drive::Samples(given) => given.to_vec(),
            Drive::Controller(_) => vec![Vec::with_capacity(samples); inputs],
        };
        let mut run = Run {
            y: vec![Vec::new(); n],
            q: vec![Vec::new(); n],
            v: vec![Vec::new(); n],
            u: Vec::new(),
            finite: true,
        };
        let mut y: State = [0.0; WIDTH];
        y[..4].copy_from_slice(&start);
        let mut track: Vec<[f64; 4]> = Vec::with_capacity(samples * substeps + 1);
        track.push([y[0], y[1], y[2], y[3]]);
        let mut modes = [0i8; 4];
        for k in 0..samples {
            let clock = Clock { step: k * substeps, inside: 0.0, h };
            let past = Past { u: &u, hold, substeps, track: &track };
            let shown = self.sensed(clock, [y[0], y[1]], &past);
            for i in 0..n {
                run.y[i].push(shown[i]);
                run.q[i].push(y[i]);
                run.v[i].push(y[2 + i]);
            }
            if let Drive::Controller(law) = &mut drive {
                let now = law(k, &shown[..n]);
                (0..inputs).for_each(|i| u[i].push(now[i]));
            }
            if k == 0 {
                self.settle(&mut y, &u);
                let past = Past { u: &u, hold, substeps, track: &track };
                for (i, place) in contacts.iter().enumerate() {
                    let rate = place.c[0] * y[2] + place.c[1] * y[3];
                    modes[i] = if rate == 0.0 {
                        self.mode_at_rest(i, clock, &y, &contacts, &modes, &past)
                    } else {
                        rate.signum() as i8
                    };
                }
            }
            if k + 1 == samples {
                break;
            }
            for s in 0..substeps {
                let clock = Clock { step: k * substeps + s, inside: 0.0, h };
                let past = Past { u: &u, hold, substeps, track: &track };
                y = self.step(clock, &y, &contacts, &mut modes, &past);
                track.push([y[0], y[1], y[2], y[3]]);
            }
            if !y.iter().all(|x| x.is_finite() && x.abs() < 1e9) {
                run.finite = false;
                break;
            }
        }
        run.u = u;
        run
    }

    /// Initial values of the states that no one gives: a lag follows its input, an extra mode its carrier.
    fn settle(&self, y: &mut State, u: &[Vec<f64>]) {
        for (index, e) in self.effects.iter().enumerate() {
            let slot = EXTRA + self.slot(index);
            match e.kind {
                Kind::ActuatorLag => y[slot] = u[e.at][0],
                Kind::UnmodeledResonance => {
                    let (d, r) = self.motion(e, y);
                    (y[slot], y[slot + 1]) = (d, r);
                }
                _ => {}
            }
        }
        if self.family == Family::DcMotor {
            y[EXTRA] = 0.0;
        }
    }
}

/// Further states of an effect.
fn states_of(kind: Kind) -> usize {
    match kind {
        Kind::PreslidingFriction
        | Kind::BoucWenHysteresis
        | Kind::ActuatorLag
        | Kind::TiringActuator
        | Kind::MaxwellElement
        | Kind::AgeingFriction => 1,
        Kind::UnmodeledResonance => 2,
        _ => 0,
    }
}

fn is_dry(kind: Kind) -> bool {
    matches!(
        kind,
        Kind::CoulombFriction
            | Kind::AsymmetricCoulombFriction
            | Kind::StribeckFriction
            | Kind::LoadDependentFriction
            | Kind::PositionFriction
            | Kind::AgeingFriction
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn effect(kind: Kind, at: usize, p: &[f64]) -> Effect {
        let mut full = [0.0; 3];
        full[..p.len()].copy_from_slice(p);
        Effect { kind, at, p: full, which: 0 }
    }

    fn quiet(samples: usize) -> Vec<Vec<f64>> {
        vec![vec![0.0; samples]]
    }

    #[test]
    fn a_damped_oscillator_follows_its_closed_form() {
        let (m, c, k) = (2.0, 0.8, 50.0);
        let machine = Machine { family: Family::Oscillator, p: vec![m, c, k], effects: vec![] };
        let run = machine.run(
            [0.3, 0.0, 0.0, 0.0],
            1000,
            0.01,
            Hold::Linear,
            Drive::Samples(&quiet(1000)),
            SUBSTEPS,
        );
        let decay = c / (2.0 * m);
        let omega = (k / m - decay * decay).sqrt();
        for i in (0..1000).step_by(37) {
            let t = 0.01 * i as f64;
            let x = 0.3 * (-decay * t).exp() * ((omega * t).cos() + decay / omega * (omega * t).sin());
            assert!((run.q[0][i] - x).abs() < 1e-9, "{t} {} {x}", run.q[0][i]);
        }
    }

    #[test]
    fn dry_friction_takes_the_same_from_every_half_period_and_then_holds() {
        // m x'' + k x + fc sign(x') = 0: every half period costs 2 fc/k; it rests inside ±fc/k.
        let machine = Machine {
            family: Family::Oscillator,
            p: vec![1.0, 0.0, 100.0],
            effects: vec![effect(Kind::CoulombFriction, 0, &[3.0])],
        };
        let half = std::f64::consts::PI / 10.0;
        let dt = half / 50.0;
        let run =
            machine.run([1.0, 0.0, 0.0, 0.0], 2000, dt, Hold::Linear, Drive::Samples(&quiet(2000)), SUBSTEPS);
        let mut amplitude = 1.0;
        for turn in 1..=15 {
            amplitude -= 0.06;
            let x = run.q[0][50 * turn];
            let sign = if turn % 2 == 0 { 1.0 } else { -1.0 };
            assert!((x - sign * amplitude).abs() < 1e-9, "{turn}: {x} {amplitude}");
        }
        let rest = run.q[0][1999];
        assert!(rest.abs() < 0.03 + 1e-12 && run.q[0][1200] == rest && run.v[0][1999] == 0.0);
    }

    #[test]
    fn energy_is_kept_where_nothing_takes_it() {
        let machine = Machine { family: Family::Pendulum, p: vec![0.3, 0.0, 5.0], effects: vec![] };
        let run = machine.run(
            [2.5, 0.0, 0.0, 0.0],
            5000,
            0.005,
            Hold::Linear,
            Drive::Samples(&quiet(5000)),
            SUBSTEPS,
        );
        let energy = |i: usize| 0.15 * run.v[0][i].powi(2) - 5.0 * run.q[0][i].cos();
        assert!((energy(4999) - energy(0)).abs() < 1e-8, "{} {}", energy(4999), energy(0));
    }
}
