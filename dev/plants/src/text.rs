//! Machines as model files: the nominal one that greybox is given and the true one that the oracle runs.
//!
//! The physics stands here a second time, in the model language; that both agree is tested kind by kind.

use std::fmt::Write as _;

use crate::kind::Kind;
use crate::machine::{Effect, Family, Hold, Machine};

/// A parameter of a family.
pub struct Named {
    /// As in a model file.
    pub name: &'static str,
    /// In the notation of a model file.
    pub unit: &'static str,
    /// Known exactly in the nominal model.
    pub fixed: bool,
}

const fn free(name: &'static str, unit: &'static str) -> Named {
    Named { name, unit, fixed: false }
}

const fn known(name: &'static str, unit: &'static str) -> Named {
    Named { name, unit, fixed: true }
}

impl Family {
    /// As it may be named to the scorer.
    pub fn name(self) -> &'static str {
        match self {
            Family::Servo => "servo",
            Family::Oscillator => "oscillator",
            Family::Pendulum => "pendulum",
            Family::TwoMass => "two_mass",
            Family::FlexibleLink => "flexible_link",
            Family::DcMotor => "dc_motor",
            Family::QuarterCar => "quarter_car",
            Family::Duffing => "duffing",
            Family::Table => "table",
        }
    }

    /// Names and units of the coordinates.
    pub fn states(self) -> &'static [(&'static str, &'static str)] {
        match self {
            Family::Servo | Family::DcMotor => &[("theta", "rad")],
            Family::Oscillator | Family::Duffing => &[("x", "m")],
            Family::Pendulum => &[("phi", "rad")],
            Family::TwoMass => &[("th1", "rad"), ("th2", "rad")],
            Family::FlexibleLink => &[("theta", "rad"), ("alpha", "rad")],
            Family::QuarterCar => &[("zs", "m"), ("zu", "m")],
            Family::Table => &[("x", "m"), ("y", "m")],
        }
    }

    /// Names and units of the inputs.
    pub fn input_names(self) -> &'static [(&'static str, &'static str)] {
        match self {
            Family::Servo | Family::DcMotor | Family::FlexibleLink => &[("v", "V")],
            Family::Oscillator | Family::Duffing => &[("f", "N")],
            Family::Pendulum => &[("tau", "N m")],
            Family::TwoMass => &[("u", "A")],
            Family::QuarterCar => &[("r", "m")],
            Family::Table => &[("u", "A"), ("w", "N")],
        }
    }

    /// Names of the equations, one per coordinate, then those of further states.
    pub fn equation_names(self) -> &'static [&'static str] {
        match self {
            Family::Servo => &["shaft"],
            Family::Oscillator | Family::Duffing => &["mass"],
            Family::Pendulum => &["arm"],
            Family::TwoMass => &["motor", "load"],
            Family::FlexibleLink => &["hub", "link"],
            Family::DcMotor => &["shaft", "coil"],
            Family::QuarterCar => &["body", "wheel"],
            Family::Table => &["axis", "beam"],
        }
    }

    /// Its parameters, in the order of [`Machine::p`].
    pub fn parameters(self) -> &'static [Named] {
        match self {
            Family::Servo => const { &[free("J", "kg m^2"), free("B", "N m s"), known("kt", "N m/V")] },
            Family::Oscillator => const { &[free("m", "kg"), free("c", "N s/m"), free("k", "N/m")] },
            Family::Pendulum => const { &[free("J", "kg m^2"), free("b", "N m s"), free("mgl", "N m")] },
            Family::TwoMass => {
                const {
                    &[
                        free("J1", "kg m^2"),
                        free("b1", "N m s"),
                        free("ks", "N m"),
                        free("cs", "N m s"),
                        free("J2", "kg m^2"),
                        free("b2", "N m s"),
                        known("kt", "N m/A"),
                    ]
                }
            }
            Family::FlexibleLink => {
                const {
                    &[
                        free("J", "kg m^2"),
                        free("B", "N m s"),
                        free("ks", "N m"),
                        free("Jl", "kg m^2"),
                        free("Bl", "N m s"),
                        known("kt", "N m/V"),
                    ]
                }
            }
            Family::DcMotor => {
                const {
                    &[
                        free("J", "kg m^2"),
                        free("b", "N m s"),
                        known("kt", "N m/A"),
                        free("L", "V s/A"),
                        known("R", "V/A"),
                    ]
                }
            }
            Family::QuarterCar => {
                const {
                    &[
                        known("ms", "kg"),
                        free("cs", "N s/m"),
                        free("ks", "N/m"),
                        free("mu", "kg"),
                        free("kt", "N/m"),
                    ]
                }
            }
            Family::Duffing => {
                const { &[free("m", "kg"), free("c", "N s/m"), free("k", "N/m"), free("k3", "N/m^3")] }
            }
            Family::Table => {
                const {
                    &[
                        free("m1", "kg"),
                        free("b1", "N s/m"),
                        free("m2", "kg"),
                        free("b2", "N s/m"),
                        free("k2", "N/m"),
                        known("kf", "N/A"),
                    ]
                }
            }
        }
    }

    /// The equations of the coordinates an input enters.
    pub fn entered(self, input: usize) -> usize {
        match self {
            Family::QuarterCar => 1,
            Family::DcMotor => 1,
            Family::Table => input,
            _ => 0,
        }
    }

    /// The motion of a place in the model language, and its rate.
    pub fn motion(self, place: usize) -> (String, String) {
        let c = self.places()[place].c;
        let names = self.states();
        match c {
            [1.0, 0.0] => (names[0].0.into(), format!("{}'", names[0].0)),
            [0.0, 1.0] => (names[1].0.into(), format!("{}'", names[1].0)),
            _ => {
                let (a, b) = (names[0].0, names[1].0);
                (format!("({a} - {b})"), format!("({a}' - {b}')"))
            }
        }
    }

    /// Names of the equations in which a force at a place enters.
    pub fn equations_of(self, place: usize) -> Vec<String> {
        let w = self.places()[place].w;
        (0..self.coordinates()).filter(|&e| w[e] != 0.0).map(|e| self.equation_names()[e].into()).collect()
    }
}

/// A term of an equation's left side: sign, the parameter in front, the rest of the product.
type Term = (char, Option<usize>, String);

/// The family's equations with what stands for the inputs and for the elastic motion.
fn equations(family: Family, u: &[String], elastic: &str) -> Vec<(Vec<Term>, Vec<Term>)> {
    let t = |sign: char, parameter: usize, rest: &str| (sign, Some(parameter), rest.to_owned());
    let input = |parameter: usize, rest: &str| vec![t('+', parameter, rest)];
    let bare = |rest: &str| vec![('+', None, rest.to_owned())];
    match family {
        Family::Servo => vec![(vec![t('+', 0, "theta''"), t('+', 1, "theta'")], input(2, &u[0]))],
        Family::Oscillator => {
            vec![(vec![t('+', 0, "x''"), t('+', 1, "x'"), t('+', 2, elastic)], bare(&u[0]))]
        }
        Family::Duffing => {
            vec![(vec![t('+', 0, "x''"), t('+', 1, "x'"), t('+', 2, elastic), t('+', 3, "x^3")], bare(&u[0]))]
        }
        Family::Pendulum => {
            vec![(vec![t('+', 0, "phi''"), t('+', 1, "phi'"), t('+', 2, "sin(phi)")], bare(&u[0]))]
        }
        Family::TwoMass => vec![
            (
                vec![t('+', 0, "th1''"), t('+', 1, "th1'"), t('+', 2, elastic), t('+', 3, "(th1' - th2')")],
                input(6, &u[0]),
            ),
            (
                vec![t('+', 4, "th2''"), t('+', 5, "th2'"), t('-', 2, elastic), t('-', 3, "(th1' - th2')")],
                vec![],
            ),
        ],
        Family::FlexibleLink => vec![
            (vec![t('+', 0, "theta''"), t('+', 1, "theta'"), t('-', 2, elastic)], input(5, &u[0])),
            (vec![t('+', 3, "(theta'' + alpha'')"), t('+', 4, "alpha'"), t('+', 2, elastic)], vec![]),
        ],
        Family::DcMotor => vec![
            (vec![t('+', 0, "theta''"), t('+', 1, "theta'"), t('-', 2, "i")], vec![]),
            (vec![t('+', 3, "i'"), t('+', 4, "i"), t('+', 2, "theta'")], bare(&u[0])),
        ],
        Family::QuarterCar => vec![
            (vec![t('+', 0, "zs''"), t('+', 1, "(zs' - zu')"), t('+', 2, elastic)], vec![]),
            (
                vec![t('+', 3, "zu''"), t('-', 1, "(zs' - zu')"), t('-', 2, elastic), t('+', 4, "zu")],
                input(4, &u[0]),
            ),
        ],
        Family::Table => vec![
            (vec![t('+', 0, "x''"), t('+', 1, "x'")], input(5, &u[0])),
            (vec![t('+', 2, "y''"), t('+', 3, "y'"), t('+', 4, elastic)], bare(&u[1])),
        ],
    }
}

/// How a model file is to be written.
pub struct Writing<'a> {
    /// Its title.
    pub name: &'a str,
    /// Values of the family's parameters.
    pub values: &'a [f64],
    /// Standard deviations of the prior, where stated.
    pub std: &'a [Option<f64>],
    /// Which coordinates a channel measures.
    pub measured: &'a [bool],
    /// What the inputs do between samples.
    pub hold: Hold,
    /// Whether units are written.
    pub units: bool,
    /// The true model: every parameter as it is, and known.
    pub truth: bool,
    /// Of the true model, leave the first parameter free in name: a prior holds it to nine digits.
    pub pinned: bool,
}

/// The machine without or with its effects as a model file.
pub fn model(machine: &Machine, w: &Writing<'_>) -> String {
    let family = machine.family;
    let effects: &[Effect] = if w.truth { &machine.effects } else { &[] };
    let unit = |u: &str| if w.units { format!("unit = \"{u}\"") } else { String::new() };
    let join = |parts: &[String]| {
        let kept: Vec<&str> = parts.iter().map(String::as_str).filter(|p| !p.is_empty()).collect();
        format!("{{ {} }}", kept.join(", "))
    };
    let mut text = format!("name = \"{}\"\n\n[inputs]\n", w.name);
    let hold = match w.hold {
        Hold::Zero => "hold = \"zero\"",
        Hold::Linear => "hold = \"linear\"",
    };
    for (name, u) in family.input_names() {
        let _ = writeln!(text, "{name} = {}", join(&[unit(u), hold.into()]));
    }
    text.push_str("\n[states]\n");
    let sensed = |i: usize| effects.iter().any(|e| e.kind.on_measurement() && e.at == i);
    for (i, (name, u)) in family.states().iter().enumerate() {
        let hidden = if !w.measured[i] || sensed(i) { "measured = false" } else { "" };
        let _ = writeln!(text, "{name} = {}", join(&[unit(u), hidden.into()]));
    }
    if family == Family::DcMotor {
        let _ = writeln!(text, "i = {}", join(&[unit("A"), "measured = false".into()]));
    }

    let value = |x: f64| format!("{x:.17e}");
    let mut parameters = String::new();
    for (i, named) in family.parameters().iter().enumerate().filter(|&(i, _)| machine.p[i] != 0.0) {
        let pinned = w.pinned && i == 0;
        let known =
            if (named.fixed || w.truth) && !pinned { "fixed = true".to_owned() } else { String::new() };
        let prior = match w.std[i].filter(|_| !named.fixed && !w.truth) {
            _ if pinned => format!("std = {:.3e}", 1e-9 * w.values[i].abs()),
            Some(std) => format!("std = {std:.3e}"),
            None => String::new(),
        };
        // The nominal values read like those of a data sheet.
        let shown = if w.truth { value(w.values[i]) } else { format!("{}", w.values[i]) };
        let _ = writeln!(
            parameters,
            "{} = {}",
            named.name,
            join(&[format!("value = {shown}"), unit(named.unit), known, prior])
        );
    }
    for (index, e) in effects.iter().enumerate() {
        for (name, x) in e.named(index) {
            let _ = writeln!(parameters, "{name} = {{ value = {}, fixed = true }}", value(x));
        }
    }

    // What stands for each input, for the elastic motion and for each parameter.
    let mut u: Vec<String> = family.input_names().iter().map(|(n, _)| (*n).to_owned()).collect();
    let mut elastic = family.elastic().map_or(String::new(), |p| family.motion(p).0);
    let mut drifting: Vec<Option<String>> = vec![None; machine.p.len()];
    let (mut states, mut own, mut measurements) = (String::new(), String::new(), String::new());
    let mut forces: Vec<Vec<(f64, String)>> = vec![Vec::new(); family.coordinates()];
    // A delay stands innermost, whatever the order of the effects.
    for (index, e) in effects.iter().enumerate().filter(|(_, e)| e.kind == Kind::InputDelay) {
        u[e.at] = format!("delay({}, {})", u[e.at], e.symbol(0, index));
    }
    for (index, e) in effects.iter().enumerate() {
        let n = |k: usize| e.symbol(k, index);
        let raw = |e: &Effect| family.input_names()[e.at].0;
        match e.kind {
            Kind::InputDelay => {}
            Kind::InputOffset => u[e.at] = format!("({} + {})", u[e.at], n(0)),
            Kind::InputSaturation => u[e.at] = format!("saturate({}, {})", u[e.at], n(0)),
            Kind::InputDeadZone => u[e.at] = format!("deadzone({}, {})", u[e.at], n(0)),
            Kind::ActuatorLag => {
                let _ = writeln!(states, "ua{index} = {{ measured = false }}");
                let _ = writeln!(own, "lag{index} = \"{}*ua{index}' + ua{index} = {}\"", n(0), raw(e));
                u[e.at] = format!("ua{index}");
            }
            Kind::TiringActuator => {
                let _ = writeln!(states, "tired{index} = {{ measured = false, initial = 0 }}");
                let _ = writeln!(
                    own,
                    "tiring{index} = \"{}*tired{index}' = abs({}) - tired{index}\"",
                    n(1),
                    raw(e)
                );
                u[e.at] = format!("({}/(1 + {}*tired{index}))", u[e.at], n(0));
            }
            Kind::SensorOffset | Kind::SensorDelay => {
                let state = family.states()[e.at].0;
                let shown = match e.kind {
                    Kind::SensorOffset => format!("{state} + {}", n(0)),
                    _ => format!("delay({state}, {})", n(0)),
                };
                let _ = writeln!(measurements, "{state} = \"{shown}\"");
            }
            Kind::ParameterDrift => {
                drifting[e.which] = Some(format!("({}*(1 + {}*t))", family.parameters()[e.which].name, n(0)));
            }
            Kind::DeadZone => elastic = format!("deadzone({}, {})", family.motion(e.at).0, n(0)),
            Kind::FeedbackDelay => elastic = format!("delay({}, {})", family.motion(e.at).0, n(0)),
            Kind::Coupling => {
                let term = |of: usize| {
                    let q = family.states()[of].0;
                    let which = e.p.iter().position(|x| *x != 0.0).unwrap_or(0);
                    format!("{}*{q}{}", n(which), ["", "'", "''"][which])
                };
                forces[e.at].push((1.0, term(1 - e.at)));
                if e.which == 1 {
                    forces[1 - e.at].push((1.0, term(e.at)));
                }
            }
            _ => {
                let force = force(family, e, index, &mut states, &mut own, &u);
                let weights = family.places()[e.at].w;
                (0..family.coordinates())
                    .filter(|&i| weights[i] != 0.0)
                    .for_each(|i| forces[i].push((weights[i], force.clone())));
            }
        }
    }
    let symbol = |i: usize| drifting[i].clone().unwrap_or_else(|| family.parameters()[i].name.to_owned());
    let render = |terms: &[Term]| {
        let mut out = String::new();
        for (sign, parameter, rest) in terms {
            if parameter.is_some_and(|p| machine.p[p] == 0.0) {
                continue;
            }
            let product = parameter.map_or(rest.clone(), |p| format!("{}*{rest}", symbol(p)));
            match (out.is_empty(), sign) {
                (true, '+') => out.push_str(&product),
                (true, _) => out.push_str(&format!("-{product}")),
                (false, s) => out.push_str(&format!(" {s} {product}")),
            }
        }
        out
    };
    text.push_str(&states);
    let _ = write!(text, "\n[parameters]\n{parameters}\n[equations]\n");
    for (i, (left, right)) in equations(family, &u, &elastic).iter().enumerate() {
        let mut left = render(left);
        for (weight, force) in forces.get(i).into_iter().flatten() {
            let sign = if *weight < 0.0 { '-' } else { '+' };
            let _ = write!(left, " {sign} ({force})");
        }
        let right = if right.is_empty() { "0".to_owned() } else { render(right) };
        let _ = writeln!(text, "{} = \"{left} = {right}\"", family.equation_names()[i]);
    }
    text.push_str(&own);
    if !measurements.is_empty() {
        let _ = write!(text, "\n[measurements]\n{measurements}");
    }
    text
}

/// A force on the left side, in the model language; states of its own are added.
fn force(
    family: Family,
    e: &Effect,
    index: usize,
    states: &mut String,
    own: &mut String,
    u: &[String],
) -> String {
    let n = |k: usize| e.symbol(k, index);
    let (d, r) = family.motion(e.at);
    match e.kind {
        Kind::ViscousFriction => format!("{}*{r}", n(0)),
        Kind::CoulombFriction => format!("{}*sign({r})", n(0)),
        Kind::AsymmetricCoulombFriction => {
            format!("0.5*({0} + {1})*sign({r}) + 0.5*({0} - {1})", n(0), n(1))
        }
        Kind::StribeckFriction => {
            format!("({0} + ({1} - {0})*exp(-({r}/{2})^2))*sign({r})", n(0), n(1), n(2))
        }
        Kind::PreslidingFriction => {
            let _ = writeln!(states, "z{index} = {{ measured = false, initial = 0 }}");
            let _ =
                writeln!(own, "bristle{index} = \"z{index}' = {r} - {}/{}*abs({r})*z{index}\"", n(0), n(1));
            format!("{}*z{index}", n(0))
        }
        Kind::QuadraticDrag => format!("{}*{r}*abs({r})", n(0)),
        Kind::LoadDependentFriction => {
            let load = match family {
                Family::TwoMass if e.at == 1 => "ks*(th1 - th2)".to_owned(),
                Family::TwoMass | Family::Servo => format!("kt*{}", u[0]),
                Family::DcMotor => "kt*i".to_owned(),
                Family::FlexibleLink => format!("kt*{}", u[0]),
                Family::Table => format!("kf*{}", u[0]),
                _ => u[0].clone(),
            };
            format!("{}*abs({load})*sign({r})", n(0))
        }
        Kind::LinearStiffness => format!("{}*{d}", n(0)),
        Kind::QuadraticStiffness => format!("{}*{d}^2", n(0)),
        Kind::CubicStiffness => format!("{}*{d}^3", n(0)),
        Kind::EndStop => format!("{}*max({d} - {}, 0)", n(0), n(1)),
        Kind::BoucWenHysteresis => {
            let _ = writeln!(states, "z{index} = {{ measured = false, initial = 0 }}");
            let _ = writeln!(
                own,
                "loop{index} = \"z{index}' = {r} - {}*abs({r})*z{index} - {}*{r}*abs(z{index})\"",
                n(1),
                n(2)
            );
            format!("{}*z{index}", n(0))
        }
        Kind::Gravity => format!("{}*sin({d})", n(0)),
        Kind::Cogging => format!("{}*sin({}*{d} + {})", n(0), n(1), n(2)),
        Kind::PositionDependentInertia => {
            let acceleration = format!("{d}''");
            format!("{0}*(cos({1}*{d})*{acceleration} - {1}/2*sin({1}*{d})*{r}^2)", n(0), n(1))
        }
        Kind::UnmodeledResonance => {
            let _ = writeln!(states, "a{index} = {{ measured = false }}");
            let _ = writeln!(
                own,
                "mode{index} = \"{}*a{index}'' + {}*(a{index} - {d}) + {}*(a{index}' - {r}) = 0\"",
                n(0),
                n(1),
                n(2)
            );
            format!("{}*({d} - a{index}) + {}*({r} - a{index}')", n(1), n(2))
        }
        Kind::ConstantOffset => n(0),
        Kind::PeriodicDisturbance => format!("{}*sin(2*pi*{}*t + {})", n(0), n(1), n(2)),
        Kind::StepDisturbance => format!("{}*step(t, {})", n(0), n(1)),
        Kind::DisplacementDamping => format!("{}*{d}^2*{r}", n(0)),
        Kind::SineOfPower => format!("{}*sin({}*{d}*{r})", n(0), n(1)),
        Kind::BreathingQuadratic => format!("{}*(1 + cos(2*pi*{}*t))*{d}^2", n(0), n(1)),
        Kind::PositionFriction => format!("{}*{d}^2*sign({r})", n(0)),
        Kind::ProductCoupling => {
            let names = family.states();
            format!("{}*{}*{}", n(0), names[0].0, names[1].0)
        }
        Kind::QuinticStiffness => format!("{}*{d}^5", n(0)),
        Kind::ParametricExcitation => format!("{}*cos(2*pi*{}*t)*{d}", n(0), n(1)),
        Kind::EddyBrake => format!("{}*{r}/(1 + ({r}/{})^2)", n(0), n(1)),
        Kind::MaxwellElement => {
            let _ = writeln!(states, "s{index} = {{ measured = false, initial = 0 }}");
            let _ = writeln!(own, "series{index} = \"{}*s{index}' = {d} - s{index}\"", n(1));
            format!("{}*({d} - s{index})", n(0))
        }
        Kind::AgeingFriction => {
            let _ = writeln!(states, "s{index} = {{ measured = false, initial = 0 }}");
            let _ = writeln!(own, "ageing{index} = \"{}*s{index}' = abs({r}) - s{index}\"", n(2));
            format!("{}*sign({r})/(1 + s{index}/{})", n(0), n(1))
        }
        Kind::OneWayDamper => format!("{}*max({r}, 0)", n(0)),
        Kind::PowerDrag => format!("{}*abs({r})^1.5*sign({r})", n(0)),
        Kind::LockingSpring => format!("{0}*0.5*(exp({d}/{1}) - exp(-({d}/{1})))", n(0), n(1)),
        // The others transform an input, a measurement or a parameter.
        _ => "0".to_owned(),
    }
}

impl Effect {
    /// Name of its parameter `k` in a model file.
    fn symbol(&self, k: usize, index: usize) -> String {
        format!("{}_e{index}", self.kind.parameters()[k])
    }

    /// Names and values of its parameters in a model file; of a coupling only the one that acts.
    fn named(&self, index: usize) -> Vec<(String, f64)> {
        let all = self.kind.parameters().iter().enumerate();
        all.filter(|&(k, _)| self.kind != Kind::Coupling || self.p[k] != 0.0)
            .map(|(k, _)| (self.symbol(k, index), self.p[k]))
            .collect()
    }

    /// Canonical names and values of its parameters, as a report should give them.
    pub fn canonical(&self) -> Vec<(&'static str, f64)> {
        let all = self.kind.parameters().iter().enumerate();
        all.filter(|&(k, _)| self.kind != Kind::Coupling || self.p[k] != 0.0)
            .map(|(k, &name)| (name, self.p[k]))
            .collect()
    }
}
