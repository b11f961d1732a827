//! The mechanisms that diagnosis can name: one file each, written in the model language.
//!
//! ```toml
//! kind   = "presliding_friction"
//! family = "friction"
//! domain = "mechanical"          # optional: makes no sense in a thermal or an electrical equation
//! on     = "motion"              # motion | equation | input | measurement | parameter | spring | …
//! force  = "s0*z"                # `replace = "…"` for an input (u), measurement (y), parameter (p), spring (k*d)
//! linear = ["s0"]                # enter linearly: the score test gives their first values
//! positive = ["s0", "fc"]        # physically positive
//! named = false                  # optional: a term of a formula, without a name of its own
//! [states.z]                     # memory: a state with an equation of its own
//! equation = "z' = d' - s0/fc*abs(d')*z"
//! unit     = "d'*t"              # has the unit of this expression
//! [inner]                        # the others: a grid of first values, later refined
//! zc = { grid = [0.01, 0.1], scale = "range(d)" }
//! [first]                        # parameters of the law that the score test reaches through others
//! fc = "s0*zc"
//! [shape]                        # optional: `shape` in the law is a function of this, free at some knots
//! of = "d'"
//! [location]                     # where the law acts, if it has a threshold
//! variable = "d'"
//! low = "-2*vs"
//! high = "2*vs"
//! [report]                       # further figures that users expect
//! breakaway = "fc/s0"
//! [experiment]                   # optional: how to drive the machine, to tell the law from its alternatives
//! drive = "beyond"               # slow, wide, loud, silent, again; around, ramp and beyond have `at`
//! at = "2*fc"                    # a frequency in Hz (around), or a magnitude of the input
//! [about]
//! signature = "…"
//! confused_with = ["…"]
//! separate = "…"
//! elsewhere = "…"                # optional: the same where nothing moves (a temperature, a level, a voltage)
//! physics = "…"                  # optional, for the book: where it comes from
//! parameters = { s0 = "…" }      # optional: what each parameter is
//! ```
//!
//! What a law acts on decides which placeholders it may use:
//!
//! | `on` | acts on | placeholders |
//! |---|---|---|
//! | `motion` | a coordinate or a difference of coordinates d | `d`, `d'`, `d''` |
//! | `load` | a motion and the torque that its joint transmits | `d`, `d'`, `load` |
//! | `drive` | the same, where that torque comes from an input | `d`, `d'`, `load` |
//! | `pair` | the equation of a motion d, from another coordinate o; `reaction` acts on o's equation | `d`, `o` and primes |
//! | `spring` | the term k·d of an existing spring, which `replace` stands in for | `k`, `d` |
//! | `feedback` | the same, also of a damper or of a gain on a difference from a reference | `k`, `d` |
//! | `equation` | an equation as a whole | – |
//! | `input`, `measurement`, `parameter` | the symbol, which `replace` stands in for | `u`; `y`; `p` |
//!
//! `t` and `pi` are known everywhere. A name listed under `linear` or `[inner]` that the law does not use
//! serves the score test alone, and `[first]` turns it into the law's own parameters (`angle(y, x)` is the angle of the
//! vector (x, y)). The law must be linear in the `linear` names, through `[first]` if need be. A law of free shape
//! ([`Shape`]) has no parameters of its own.

mod check;
mod file;

use std::collections::BTreeMap;

use greybox_model::{Expr, Func, Table};
use serde::Deserialize;

use file::line_of;

/// What a mechanism acts on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum On {
    /// A motion d: a coordinate or a difference of coordinates; `force` enters as F(d, d').
    Motion,
    /// An equation as a whole; `force` does not depend on a motion.
    Equation,
    /// An input u, which `replace` stands in for.
    Input,
    /// A measurement y, which `replace` stands in for.
    Measurement,
    /// A parameter p of the nominal model, which `replace` stands in for.
    Parameter,
    /// The term k·d of an existing spring, which `replace` stands in for.
    Spring,
    /// The same, also where a parameter multiplies a rate or compares d with a reference: a feedback.
    Feedback,
    /// The equation of a motion d, driven by another coordinate o.
    Pair,
    /// A motion together with the force that its joint transmits.
    Load,
    /// The same where that force drives the motion: terms that hold an input.
    Drive,
}

impl On {
    /// Names a law may use besides its parameters and states.
    fn placeholders(self) -> &'static [&'static str] {
        match self {
            On::Motion => &["d", "t", "pi"],
            On::Equation => &["t", "pi"],
            On::Input => &["u", "t", "pi"],
            On::Measurement => &["y", "t", "pi"],
            On::Parameter => &["p", "t", "pi"],
            On::Spring | On::Feedback => &["k", "d", "t", "pi"],
            On::Pair => &["d", "o", "t", "pi"],
            On::Load | On::Drive => &["d", "load", "t", "pi"],
        }
    }

    /// As a file writes it.
    pub fn name(self) -> &'static str {
        match self {
            On::Motion => "motion",
            On::Equation => "equation",
            On::Input => "input",
            On::Measurement => "measurement",
            On::Parameter => "parameter",
            On::Spring => "spring",
            On::Feedback => "feedback",
            On::Pair => "pair",
            On::Load => "load",
            On::Drive => "drive",
        }
    }

    /// Whether its law stands in for something (else it is a force that is added).
    pub fn replaces(self) -> bool {
        matches!(self, On::Input | On::Measurement | On::Parameter | On::Spring | On::Feedback)
    }
}

/// The physics to which a mechanism belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Domain {
    /// Bodies that move: it is no candidate where the units show a thermal or an electrical equation.
    Mechanical,
}

/// A parameter that does not enter linearly.
#[derive(Debug, Clone, PartialEq)]
pub struct Inner {
    /// Its name.
    pub name: String,
    /// First values, in units of the scale.
    pub grid: Vec<f64>,
    /// The scale.
    pub scale: Scale,
    /// Smallest admissible value, in units of the scale.
    pub low: f64,
    /// Largest admissible value, in units of the scale.
    pub high: f64,
    /// The parameter is an angular frequency over this variable: first values come from the spectrum of
    /// what is left over, besides the grid.
    pub spectral: Option<Expr>,
    /// What a spectral law is multiplied by.
    pub carrier: Option<Expr>,
    /// It stays at its first value: a size that other parameters are relative to.
    pub fixed: bool,
}

impl Inner {
    /// A size that stays as it is.
    fn fixed(name: &str, scale: Scale) -> Inner {
        Inner {
            name: name.to_string(),
            grid: vec![1.0],
            scale,
            low: 0.0,
            high: f64::INFINITY,
            spectral: None,
            carrier: None,
            fixed: true,
        }
    }

    /// Smallest and largest admissible value, in the unit of its `scale`.
    pub(crate) fn bounds(&self, scale: f64) -> (f64, f64) {
        (self.low * scale, self.high * scale)
    }
}

/// A function of free shape in a law, which writes `shape` where it stands.
///
/// ```text
/// shape(x) = sf h^½ Σᵢ slopeᵢ Bᵢ(z̄),    Bᵢ″ = 1/h from kᵢ − h/2 to kᵢ + h/2 and 0 elsewhere,    z̄ = x/sr held at ± 3
/// ```
///
/// over the knots kᵢ = 0, ± h, ± 2h, … within ± 3, with sr the root mean square of x. On the side of its knot away from zero
/// Bᵢ is the straight line |z̄| − |kᵢ|, and about the knot a parabola: each knot changes the slope by sf h^½ slopeᵢ. With these
/// changes normal about zero the slope is a Wiener process (Wahba, *Spline Models for Observational Data*, 1990, §1.5), whose
/// size sf is. A constant and a straight line are no part of it: they have terms of their own.
#[derive(Debug, Clone, PartialEq)]
pub struct Shape {
    /// The variable x.
    pub of: Expr,
    /// The law, with the variable `shape` for the function.
    law: Expr,
}

impl Shape {
    /// Distance of the knots, and where they end, over the root mean square of the variable.
    const STEP: f64 = 0.25;
    const END: f64 = 3.0;
    /// Knots on either side of zero, between the ends.
    const SIDE: usize = (Shape::END / Shape::STEP) as usize - 1;
    /// Values of the table for each knot: a straight line between them is as good as the parabola.
    const FINER: usize = 4;
    /// Names of the root mean square and of the size.
    pub(crate) const SIZES: [&'static str; 2] = ["sr", "sf"];

    /// Names of the changes of the slope, one for each knot, the one at zero in the middle.
    fn changes() -> Vec<String> {
        (1..=2 * Shape::SIDE + 1).map(|i| format!("slope{i}")).collect()
    }

    /// The function over its size, at z between the ends: as sums over where the parabolas begin and end, on either side of
    /// zero.
    fn sum(z: &Expr) -> Expr {
        let names = Shape::changes();
        let change = |i: usize| Expr::var(&names[i]);
        let (side, middle) = (Shape::SIDE, Expr::var(&names[Shape::SIDE]) * z.clone() * z.clone());
        let beyond = |at: &Expr, edge: f64| {
            let over = Expr::Call(Func::Max, vec![at.clone() - Expr::Num(edge), Expr::Num(0.0)]);
            over.clone() * over
        };
        let half = |at: Expr, knot: &dyn Fn(usize) -> Expr| {
            let edges = (0..=side).map(|i| {
                let next = if i < side { knot(i + 1) } else { Expr::Num(0.0) };
                (next - knot(i)) * beyond(&at, (i as f64 + 0.5) * Shape::STEP)
            });
            edges.collect::<Vec<_>>()
        };
        let above = half(z.clone(), &|i| change(side + i));
        let below = half(Expr::Num(0.0) - z.clone(), &|i| change(side - i));
        let sum = above.into_iter().chain(below).fold(middle, |a, b| a + b);
        Expr::Num(0.5 / Shape::STEP.sqrt()) * sum
    }

    /// The law as a sum over the knots.
    fn expanded(&self) -> Expr {
        let [root, size] = Shape::SIZES.map(Expr::var);
        let above = Expr::Call(Func::Max, vec![self.of.clone() / root, Expr::Num(-Shape::END)]);
        let held = Expr::Call(Func::Min, vec![above, Expr::Num(Shape::END)]);
        self.with(&(size * Shape::sum(&held)))
    }

    /// The law with this function for its shape.
    fn with(&self, function: &Expr) -> Expr {
        self.law.substitute(&|name, _| (name == "shape").then(|| function.clone()))
    }

    /// The law with the function as a table whose largest value is one, of these changes of the slope, and that largest value
    /// over the size.
    fn tabulated(&self, changes: &[f64]) -> (Expr, f64) {
        let names = Shape::changes();
        let change = |name: &str, _| names.iter().position(|n| n == name).map(|i| changes[i]);
        let value = |z: f64| Shape::sum(&Expr::Num(z)).eval(&change).unwrap_or(0.0);
        let last = (Shape::FINER * (Shape::SIDE + 1)) as i32;
        let knots: Vec<f64> =
            (-last..=last).map(|i| f64::from(i) * Shape::STEP / Shape::FINER as f64).collect();
        let values: Vec<f64> = knots.iter().map(|z| value(*z)).collect();
        let largest = values.iter().fold(f64::MIN_POSITIVE, |m, v| m.max(v.abs()));
        // (Four digits are closer than any recording tells a force.)
        let rounded = |v: f64| Expr::Num((1e4 * v / largest).round() / 1e4 + 0.0);
        let [root, size] = Shape::SIZES.map(Expr::var);
        let table =
            Table::call(self.of.clone() / root, &knots, values.iter().copied().map(rounded).collect());
        (self.with(&(size * table)), largest)
    }
}

/// A state of a mechanism's own.
#[derive(Debug, Clone, PartialEq)]
pub struct Memory {
    /// Its name.
    pub name: String,
    /// Left side of its equation.
    pub lhs: Expr,
    /// Right side.
    pub rhs: Expr,
    /// An expression of its unit.
    pub unit: Expr,
    /// What it and its derivatives are likely to be when a recording starts (zero where not said).
    pub start: Vec<Expr>,
}

/// First value of a parameter, from those of the score test.
#[derive(Debug, Clone, PartialEq)]
pub enum First {
    /// An expression.
    Value(Expr),
    /// The angle of the vector (x, y): `angle(y, x)`.
    Angle(Expr, Expr),
}

impl First {
    fn eval(&self, value: &dyn Fn(&str) -> Option<f64>) -> Option<f64> {
        let of = |e: &Expr| e.eval(&|n, _| value(n));
        match self {
            First::Value(e) => of(e),
            First::Angle(y, x) => Some(of(y)?.atan2(of(x)?)),
        }
    }
}

/// A size read off the data.
#[derive(Debug, Clone, PartialEq)]
pub enum Scale {
    /// One.
    One,
    /// The sample interval.
    Step,
    /// Root mean square of an expression.
    Rms(Expr),
    /// Largest absolute value.
    Max(Expr),
    /// Largest value (one-sided).
    Top(Expr),
    /// Largest minus smallest value.
    Range(Expr),
    /// One over the range.
    PerRange(Expr),
    /// Angular frequency: root mean square of the time derivative over that of the expression.
    Frequency(Expr),
    /// Length of the longest recording, s.
    Duration,
    /// One over the duration.
    PerDuration,
}

/// Where a law with a threshold acts: `low ≤ variable ≤ high`, open where not given.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Expression in d, d', u.
    pub variable: Expr,
    /// Lower end, an expression in the parameters.
    pub low: Option<Expr>,
    /// Upper end.
    pub high: Option<Expr>,
}

/// How to drive the machine so that a recording tells a mechanism from its alternatives (`[experiment]` in its file): with formulas of
/// its parameters and of the figures of its report, or with numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Excitation<T = Expr> {
    /// Slowly, up to the present amplitude.
    Slow,
    /// Slowly, and further than now.
    Wide,
    /// As now, and louder.
    Loud,
    /// The input at zero.
    Silent,
    /// The same again.
    Again,
    /// A sine around this frequency, Hz.
    Around(T),
    /// A slow ramp of the input to this magnitude.
    Ramp(T),
    /// Steps of the input beyond this magnitude.
    Beyond(T),
}

impl Excitation {
    /// In numbers (SI), where `value` has all that its formula holds and the number is positive.
    pub fn evaluated(&self, value: &dyn Fn(&str) -> Option<f64>) -> Option<Excitation<f64>> {
        let number = |formula: &Expr| {
            let constant = |name: &str| (name == "pi").then_some(std::f64::consts::PI);
            let found = formula.eval(&|name, _| constant(name).or_else(|| value(name)));
            found.filter(|v| v.is_finite() && *v > 0.0)
        };
        Some(match self {
            Excitation::Slow => Excitation::Slow,
            Excitation::Wide => Excitation::Wide,
            Excitation::Loud => Excitation::Loud,
            Excitation::Silent => Excitation::Silent,
            Excitation::Again => Excitation::Again,
            Excitation::Around(at) => Excitation::Around(number(at)?),
            Excitation::Ramp(at) => Excitation::Ramp(number(at)?),
            Excitation::Beyond(at) => Excitation::Beyond(number(at)?),
        })
    }
}

/// Prose for the report and the book.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct About {
    /// What it looks like in data.
    pub signature: String,
    /// Kinds it is taken for.
    #[serde(default)]
    pub confused_with: Vec<String>,
    /// The recording that would separate them.
    pub separate: String,
    /// The same where nothing moves: for the equation of a temperature, a level, a voltage.
    #[serde(default)]
    pub elsewhere: String,
    /// Where it comes from, and its source in the field.
    #[serde(default)]
    pub physics: String,
    /// What each parameter of the law is, by name.
    #[serde(default)]
    pub parameters: BTreeMap<String, String>,
}

/// One mechanism.
#[derive(Debug, Clone, PartialEq)]
pub struct Mechanism {
    /// Name of the kind.
    pub kind: String,
    /// Family of kinds.
    pub family: String,
    /// The only physics in which it makes sense, if there is one.
    pub domain: Option<Domain>,
    /// What it acts on.
    pub on: On,
    /// Whether diagnosis names it; else it is a term that a formula may hold where no name reaches.
    pub named: bool,
    /// The force, or the replacement.
    pub law: Expr,
    /// On a pair: the force on the other coordinate's equation.
    pub reaction: Option<Expr>,
    /// States of its own.
    pub states: Vec<Memory>,
    /// Parameters that enter linearly.
    pub linear: Vec<String>,
    /// Parameters that are physically positive.
    pub positive: Vec<String>,
    /// The other parameters.
    pub inner: Vec<Inner>,
    /// The function of free shape that it holds, if it does.
    pub shape: Option<Shape>,
    /// Parameters of the law that the score test reaches through others.
    pub first: Vec<(String, First)>,
    /// Further figures for the report, expressions in the parameters.
    pub report: Vec<(String, Expr)>,
    /// Names of the law's own parameters: as they stand in an improved model.
    own: Vec<String>,
    /// Rank among equals: the lower is named, the others are its equivalents.
    pub rank: u8,
    /// The law acts rarely: judged by what it gains where it acts.
    pub rare: bool,
    /// The law acts all the time with one strength: every part of a recording must show it.
    pub steady: bool,
    /// The law knows the absolute zero of temperature (radiation); the others are offered only where they hold on any
    /// scale on which the equations do.
    pub absolute: bool,
    /// Reversals of the motion that the data must show at least (a memory is seen by returning).
    pub reversals: usize,
    /// Whether the mirror image (d → −d) is another candidate.
    pub mirror: bool,
    /// Kinds of which this one is a refinement: at the same place it replaces them.
    pub refines: Vec<String>,
    /// Kinds that this one casts doubt on where it explains as much; it is no candidate and never named itself.
    pub doubts: Vec<String>,
    /// Expressions in the parameters that must not be negative (fs − fc of Stribeck friction).
    pub require: Vec<Expr>,
    /// Extra complexity beyond the number of parameters.
    pub surcharge: f64,
    /// Where it acts, for laws with a threshold.
    pub region: Option<Region>,
    /// The sum of other mechanisms at the same place that it equals exactly: (kind, parameter,
    /// expression in this mechanism's parameters). Where all of them are candidates, it is reported as
    /// that sum, with itself as an equivalent alternative.
    pub equals: Vec<(String, String, Expr)>,
    /// Kinds of other physics whose law is this one at some values of their parameters, in the same form: they are
    /// equivalent alternatives wherever this one is found.
    pub special_case: Vec<(String, String, Expr)>,
    /// The excitation that tells it from its alternatives, if one is stated.
    pub excitation: Option<Excitation>,
    /// Prose.
    pub about: About,
}

/// A mechanism file that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{file}{}: {message}", .line.map(|l| format!(", line {l}")).unwrap_or_default())]
pub struct MechanismError {
    /// Name of the file.
    pub file: String,
    /// Line of the file, where the fault is in one; the first is 1.
    pub line: Option<usize>,
    /// What is wrong and the fix.
    pub message: String,
}

impl Mechanism {
    /// Whether it is what a formula is a sum of: something that vanishes with its strengths and knows no time, a force on one
    /// motion or, without a name, a change of an input or of a reading. One that equals the sum of others is none.
    pub fn is_term(&self) -> bool {
        !self.linear.is_empty()
            && self.vanishes()
            && self.reaction.is_none()
            && self.doubts.is_empty()
            && self.equals.is_empty()
            && !self.law.mentions("t")
    }

    /// Whether nothing is left of the law without its strengths. (A change with a name is no sum: it is tried alone.)
    fn vanishes(&self) -> bool {
        let base = match self.on {
            On::Input if !self.named => Expr::var("u"),
            On::Measurement if !self.named => Expr::var("y"),
            on if on.replaces() => return false,
            _ => return true,
        };
        let without = |name: &str, _| self.linear.iter().any(|l| l == name).then_some(Expr::Num(0.0));
        self.law.substitute(&without).simplify() == base
    }

    /// Whether such a force is a function of the motion times one coefficient.
    pub(crate) fn is_plain(&self) -> bool {
        self.states.is_empty() && self.inner.is_empty() && self.first.is_empty() && self.linear.len() == 1
    }

    /// Whether this law of free shape can be what another one is: a curve over the same one variable.
    pub(crate) fn is_shape_of(&self, other: &Mechanism) -> bool {
        let Some(shape) = &self.shape else { return false };
        let placeholders = self.on.placeholders();
        let moving = |of: &Expr| {
            let mut variables = of.variables();
            variables.retain(|(name, _)| **name != *"pi" && placeholders.contains(&&**name));
            variables
        };
        let own = moving(&shape.of);
        let [(name, primes)] = &own[..] else { return false };
        let is_curve = || other.law.affine_in(&[(name, *primes)]).is_none();
        self.on == other.on && other.states.is_empty() && moving(&other.law) == own && is_curve()
    }

    /// A law of free shape with the numbers of its function in a table, and what is left of these values of its parameters.
    pub(crate) fn tabulated(&self, values: &[f64]) -> Option<(Mechanism, Vec<f64>)> {
        let shape = self.shape.as_ref()?;
        let of = |name: &str| self.own.iter().position(|own| own == name).map(|i| values[i]);
        let changes: Vec<f64> = self.linear.iter().map(|name| of(name)).collect::<Option<_>>()?;
        let (law, largest) = shape.tabulated(&changes);
        let [root, size] = Shape::SIZES;
        let own = Shape::SIZES.map(str::to_string).to_vec();
        let left = vec![of(root)?, of(size)? * largest];
        Some((Mechanism { law, own, linear: Vec::new(), ..self.clone() }, left))
    }

    /// Which of the law's own parameters vanish with its force: those that grow in proportion with its strengths, and all of
    /// a law that has none.
    pub(crate) fn vanish_with_force(&self) -> Vec<bool> {
        if self.linear.is_empty() {
            return vec![true; self.own.len()];
        }
        let at = |strength: f64| {
            let linear: Vec<f64> = (1..=self.linear.len()).map(|i| strength * i as f64).collect();
            let inner: Vec<f64> = (1..=self.inner.len()).map(|i| 0.7 * i as f64).collect();
            self.values(&linear, &inner)
        };
        let (Some(once), Some(twice)) = (at(1.0), at(2.0)) else { return vec![false; self.own.len()] };
        once.iter().zip(twice).map(|(a, b)| *a != 0.0 && (b / a - 2.0).abs() < 1e-9).collect()
    }

    /// The recording that separates it from others, in the words of what moves or of what does not.
    pub fn separate(&self, moves: bool) -> &str {
        if moves || self.about.elsewhere.is_empty() { &self.about.separate } else { &self.about.elsewhere }
    }

    /// Whether it is a constant and nothing else: a force, or what is added to an input or a measurement.
    pub fn is_constant(&self) -> bool {
        let [own] = &self.own[..] else { return false };
        let added = |name: &str| {
            let (symbol, own) = (Expr::var(name), Expr::var(own));
            self.law == symbol.clone() + own.clone() || self.law == own + symbol
        };
        self.states.is_empty()
            && self.doubts.is_empty()
            && match self.on {
                On::Equation => self.law == Expr::var(own),
                On::Input => added("u"),
                On::Measurement => added("y"),
                _ => false,
            }
    }

    /// Every name given to a parameter, of the law or of the score test.
    fn names(&self) -> impl Iterator<Item = &str> {
        self.linear
            .iter()
            .map(String::as_str)
            .chain(self.inner.iter().map(|i| i.name.as_str()))
            .chain(self.first.iter().map(|f| f.0.as_str()))
    }

    /// The law with everything that belongs to it.
    fn expressions(&self) -> impl Iterator<Item = &Expr> {
        std::iter::once(&self.law)
            .chain(&self.reaction)
            .chain(self.states.iter().flat_map(|s| [&s.lhs, &s.rhs]))
    }

    fn uses(&self, name: &str) -> bool {
        self.expressions().any(|e| e.mentions(name))
    }

    /// Whether the law depends on the placeholder with this many primes.
    pub fn depends_on(&self, placeholder: &str, primes: u8) -> bool {
        self.expressions().any(|e| e.contains(placeholder, primes))
    }

    /// What `[equals]` and `[special_case]` say: section, kind, parameter, its value.
    fn of_others(&self) -> impl Iterator<Item = (&'static str, &str, &str, &Expr)> {
        let equals = self.equals.iter().map(|e| ("equals", e));
        let special = self.special_case.iter().map(|e| ("special_case", e));
        equals.chain(special).map(|(section, (kind, parameter, e))| (section, &**kind, &**parameter, e))
    }

    /// The kinds of which it is a special case.
    pub fn wider(&self) -> impl Iterator<Item = &str> {
        let mut kinds: Vec<&str> = self.special_case.iter().map(|s| &*s.0).collect();
        kinds.dedup();
        kinds.into_iter()
    }

    /// Whether the law of `other` is this one at the values of `[special_case]`.
    fn is_special_case_of(&self, other: &Mechanism) -> bool {
        let own = |n: &str| self.own.iter().position(|p| p == n).map(|i| 0.7 + 0.31 * i as f64);
        let given = |n: &str| {
            let (.., e) = self.special_case.iter().find(|(kind, p, _)| *kind == other.kind && p == n)?;
            e.eval(&|n, _| own(n))
        };
        self.agrees_with(other, &|_, n| own(n), &|_, n| given(n))
    }

    /// Whether this law, without a memory, is the other, of one parameter, where its linear parameters all have that
    /// one's value, whatever its inner ones.
    pub(crate) fn is_at_equal_strengths(&self, other: &Mechanism) -> bool {
        let one = other.linear.len() == 1 && other.own == other.linear;
        let mine = |k: u8, n: &str| {
            let inner =
                self.own.iter().position(|p| p == n).map(|i| 0.3 + 0.31 * i as f64 + 0.17 * f64::from(k));
            if self.linear.iter().any(|l| l == n) { Some(0.7) } else { inner }
        };
        one && self.states.is_empty() && self.agrees_with(other, &mine, &|_, _| Some(0.7))
    }

    /// Whether the laws are alike where their own parameters have these values, which may differ from point to point:
    /// by numbers, at several points.
    fn agrees_with(
        &self,
        other: &Mechanism,
        mine: &dyn Fn(u8, &str) -> Option<f64>,
        theirs: &dyn Fn(u8, &str) -> Option<f64>,
    ) -> bool {
        let names = |m: &Mechanism| m.states.iter().map(|s| s.name.clone()).collect::<Vec<_>>();
        let count = |m: &Mechanism| m.expressions().count();
        let alike = self.on == other.on && names(self) == names(other) && count(self) == count(other);
        let at = |k: u8, m: &Mechanism, e: &Expr, value: &dyn Fn(u8, &str) -> Option<f64>| {
            let own = |n: &str| m.own.iter().any(|p| p == n);
            e.eval(&|n, primes| if own(n) { value(k, n) } else { Some(arbitrary(k, n, primes)) })
        };
        let agree = |k: u8, a: &Expr, b: &Expr| {
            let both = at(k, self, a, mine).zip(at(k, other, b, theirs));
            both.is_some_and(|(a, b)| (a - b).abs() <= 1e-9 * (a.abs() + b.abs()))
        };
        alike && (0..8).all(|k| self.expressions().zip(other.expressions()).all(|(a, b)| agree(k, a, b)))
    }

    /// The law's own parameters at values of the score test (linear ones, inner ones).
    pub fn values(&self, linear: &[f64], inner: &[f64]) -> Option<Vec<f64>> {
        let given = |n: &str| {
            if n == "pi" {
                return Some(std::f64::consts::PI);
            }
            if let Some(i) = self.linear.iter().position(|l| l == n) {
                return linear.get(i).copied();
            }
            self.inner.iter().position(|i| i.name == n).and_then(|i| inner.get(i).copied())
        };
        self.own
            .iter()
            .map(|n| match self.first.iter().find(|f| f.0 == *n) {
                Some((_, first)) => first.eval(&given),
                None => given(n),
            })
            .collect()
    }

    /// Number of parameters plus the surcharge.
    pub fn complexity(&self) -> f64 {
        self.own.len() as f64 + self.surcharge
    }

    /// Names of the law's own parameters.
    pub fn parameters(&self) -> impl Iterator<Item = &str> {
        self.own.iter().map(String::as_str)
    }

    /// The inner parameter of this name.
    pub fn inner(&self, name: &str) -> Option<(usize, &Inner)> {
        self.inner.iter().enumerate().find(|i| i.1.name == name)
    }
}

static BUILT_IN: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/mechanisms.rs"));

/// The file names of the built-in library, in the order of [`built_in`].
pub fn built_in_files() -> impl Iterator<Item = &'static str> {
    BUILT_IN.iter().map(|(file, _)| *file)
}

/// The built-in library, in the order of the file names.
///
/// # Errors
/// Only when a built-in file is wrong, which a test excludes.
pub fn built_in() -> Result<Vec<Mechanism>, MechanismError> {
    combine(&[]).map(|library| library.mechanisms)
}

/// The built-in library with files of one's own.
#[derive(Debug, Clone, PartialEq)]
pub struct Library {
    /// All mechanisms: the built-in ones in the order of their file names, then the others as given.
    pub mechanisms: Vec<Mechanism>,
    /// Files that were added.
    pub added: Vec<String>,
    /// Files that stand in for the built-in one of their name and kind.
    pub replaced: Vec<String>,
}

/// Adds files (name, text) to the built-in library. A file with the name and the kind of a built-in one
/// replaces it.
///
/// ```
/// let springs = r#"
/// kind   = "quintic_stiffness"
/// family = "stiffness"
/// on     = "motion"
/// force  = "k5*d^5"
/// linear = ["k5"]
///
/// [about]
/// signature = "a spring that hardens late and steeply"
/// separate  = "the resonance measured at several amplitudes"
/// "#;
/// let library = greybox_diagnose::library::combine(&[("quintic.toml".into(), springs.into())])?;
/// assert_eq!(library.added, ["quintic.toml"]);
/// # Ok::<(), greybox_diagnose::MechanismError>(())
/// ```
///
/// # Errors
/// As [`Mechanism::from_toml`]; and where `refines`, `doubts`, `[equals]` or `[special_case]` names a kind or a parameter
/// that no mechanism of the whole library has, or a special case is none.
pub fn combine(own: &[(String, String)]) -> Result<Library, MechanismError> {
    let mut files: Vec<(&str, &str, Mechanism)> = Vec::new();
    for &(file, text) in BUILT_IN {
        files.push((file, text, Mechanism::from_toml(text, file)?));
    }
    let (mut added, mut replaced) = (Vec::new(), Vec::new());
    for (file, text) in own {
        let mechanism = Mechanism::from_toml(text, file)?;
        match files.iter_mut().find(|(name, _, m)| name == file && m.kind == mechanism.kind) {
            Some(entry) => {
                *entry = (file, text, mechanism);
                replaced.push(file.clone());
            }
            None => {
                files.push((file, text, mechanism));
                added.push(file.clone());
            }
        }
    }
    for (file, text, mechanism) in &files {
        let others = || files.iter().map(|f| &f.2);
        mechanism.check_relations(others).map_err(|fault| MechanismError {
            file: (*file).to_string(),
            line: line_of(text, &fault.section, &fault.key),
            message: fault.message,
        })?;
    }
    Ok(Library { mechanisms: files.into_iter().map(|f| f.2).collect(), added, replaced })
}

/// A number for a name and its derivative at a point, the same every time: any will do where laws are compared, another for
/// each, of either sign.
pub(crate) fn arbitrary(point: u8, name: &str, primes: u8) -> f64 {
    // (The order of the letters counts.)
    let name = name.bytes().fold(0.0, |sum, b| 1.3 * sum + f64::from(b));
    (1.7 * f64::from(point) + 0.9 * f64::from(primes) + name).sin()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_library_reads_and_its_kinds_are_its_file_names() {
        let library = built_in().unwrap();
        assert!(library.len() >= 11);
        for (mechanism, (file, _)) in library.iter().zip(BUILT_IN) {
            assert!(file.starts_with(&mechanism.kind), "{file}: {}", mechanism.kind);
            assert!(!mechanism.about.signature.is_empty());
            assert!(!mechanism.named || !mechanism.about.physics.is_empty(), "{file}: [about] physics");
            let described: Vec<&String> = mechanism.about.parameters.keys().collect();
            // (The changes of a shape's slope are not reported.)
            let is_told = |name: &&String| mechanism.shape.is_none() || !mechanism.linear.contains(*name);
            let mut own: Vec<&String> = mechanism.own.iter().filter(is_told).collect();
            own.sort();
            assert_eq!(described, own, "{file}: [about] parameters");
            for kind in &mechanism.about.confused_with {
                assert!(library.iter().any(|m| m.kind == *kind), "{file}: confused with `{kind}`");
            }
        }
    }

    const HEAD: &str = "kind = \"k\"\nfamily = \"f\"\non = \"motion\"\n";
    const TAIL: &str = "\n[about]\nsignature = \"s\"\nseparate = \"e\"\n";

    /// Line and message of a file on a motion.
    fn error(rest: &str) -> (Option<usize>, String) {
        let e = Mechanism::from_toml(&format!("{HEAD}{rest}"), "x.toml").unwrap_err();
        assert!(e.to_string().starts_with("x.toml"), "{e}");
        (e.line, e.message)
    }

    #[test]
    fn a_good_file_is_read() {
        let text = format!("{HEAD}force = \"fc*sign(d')\"\nlinear = [\"fc\"]{TAIL}");
        assert_eq!(Mechanism::from_toml(&text, "x.toml").unwrap().parameters().collect::<Vec<_>>(), ["fc"]);
    }

    #[test]
    fn words_and_domain_are_those_of_the_file() {
        let read = |text: &str| Mechanism::from_toml(text, "x.toml").unwrap();
        let body = "force = \"kx*d\"\nlinear = [\"kx\"]";
        let plain = read(&format!("{HEAD}{body}{TAIL}"));
        assert_eq!((plain.domain, plain.separate(true), plain.separate(false)), (None, "e", "e"));
        let both = read(&format!("{HEAD}domain = \"mechanical\"\n{body}{TAIL}elsewhere = \"s\"\n"));
        assert_eq!(both.domain, Some(Domain::Mechanical));
        assert_eq!((both.separate(true), both.separate(false)), ("e", "s"));
    }

    /// A change of an input or a reading is a term where nothing of it is left without its strengths, and it has no name.
    #[test]
    fn what_vanishes_with_its_strengths_is_a_term() {
        let is_term = |on: &str, law: &str| {
            let text = format!(
                "kind = \"k\"\nfamily = \"f\"\non = \"{on}\"\nnamed = false\n{law}\nlinear = [\"c\"]{TAIL}"
            );
            Mechanism::from_toml(&text, "x.toml").is_ok_and(|m| m.is_term())
        };
        assert!(
            is_term("measurement", "replace = \"y + c*y^2\"")
                && is_term("input", "replace = \"u + c*u*abs(u)\"")
        );
        assert!(!is_term("input", "replace = \"c*u\"") && !is_term("measurement", "replace = \"2*y + c\""));
        let library = built_in().unwrap();
        let law = |kind: &str| library.iter().find(|m| m.kind == kind).unwrap();
        assert!(!law("sensor_offset").is_term());
        for kind in ["fading_input", "quadratic_reading", "free_rate_force", "free_reading_characteristic"] {
            assert!(law(kind).is_term(), "{kind}");
        }
    }

    #[test]
    fn a_shape_can_be_any_curve_over_its_variable() {
        let library = built_in().unwrap();
        let law = |kind: &str| library.iter().find(|m| m.kind == kind).unwrap();
        let of = |shape: &str, kind: &str| law(shape).is_shape_of(law(kind));
        for kind in ["cubic_stiffness", "asymmetric_stiffness", "end_stop", "cogging"] {
            assert!(of("free_position_force", kind) && !of("free_rate_force", kind), "{kind}");
        }
        assert!(
            of("free_rate_force", "quadratic_drag") && of("free_reading_characteristic", "cubic_reading")
        );
        // A line, a constant, more than one variable, a memory; a product is no single variable.
        for kind in
            ["viscous_friction", "constant_offset", "position_dependent_damping", "presliding_friction"]
        {
            assert!(!of("free_rate_force", kind) && !of("free_position_force", kind), "{kind}");
        }
        assert!(!of("free_power_force", "quadratic_drag") && !of("quadratic_drag", "quadratic_drag"));
    }

    /// A law of free shape is the same function before and after its numbers stand in a table, no line and no constant.
    #[test]
    fn a_free_shape_is_a_table() {
        let text = "kind = \"k\"\nfamily = \"f\"\non = \"motion\"\nnamed = false\nforce = \"d'*shape\"\n[shape]\nof = \"d\"";
        let shape = Mechanism::from_toml(&format!("{text}{TAIL}"), "x.toml").unwrap();
        assert!(shape.is_term() && !shape.is_plain());
        let changes: Vec<f64> = (0..shape.linear.len()).map(|i| (1.0 + i as f64 * 1.7).sin()).collect();
        let values = shape.values(&changes, &[0.2, 5.0]).unwrap();
        let (table, left) = shape.tabulated(&values).unwrap();
        assert_eq!(table.parameters().collect::<Vec<_>>(), ["sr", "sf"]);
        let at = |m: &Mechanism, own: &[f64], d: f64| {
            let of = |n: &str, primes: u8| match (n, primes) {
                ("d", 0) => Some(d),
                ("d", 1) => Some(1.0),
                _ => m.parameters().position(|p| p == n).map(|i| own[i]),
            };
            m.law.eval(&of).unwrap()
        };
        let grid = (-40..=40).map(|i| 0.02 * f64::from(i));
        let most = grid.clone().map(|d| at(&shape, &values, d).abs()).fold(0.0, f64::max);
        assert!((most / left[1] - 1.0).abs() < 1e-9, "the size is the largest value: {most} {}", left[1]);
        for d in grid {
            let (before, after) = (at(&shape, &values, d), at(&table, &left, d));
            // The parabola's curvature, sf/√h at most, over the eighth of the squared distance of the values.
            let bound = 5.0 / Shape::STEP.sqrt() * (Shape::STEP / Shape::FINER as f64).powi(2) / 8.0;
            assert!((before - after).abs() < bound, "{d}: {before} {after}");
        }
        assert_eq!(at(&shape, &values, 0.0), 0.0);
        let [edge, beyond] = [0.6, 0.7].map(|d| at(&table, &left, d));
        assert!((beyond - edge).abs() < 1e-12 * most, "held beyond the last knot: {edge} {beyond}");
    }

    #[test]
    fn constants_are_told_by_their_law() {
        let constants: Vec<String> =
            built_in().unwrap().into_iter().filter(Mechanism::is_constant).map(|m| m.kind).collect();
        assert_eq!(constants, ["constant_offset", "input_offset", "sensor_offset"]);
    }

    /// What is said where nothing moves names nothing that moves.
    #[test]
    fn words_elsewhere_are_not_those_of_mechanics() {
        for mechanism in built_in().unwrap() {
            let words = &mechanism.about.elsewhere;
            for mechanical in
                ["motion", "resonance", "travel", "speed", "machine", "friction", "gravity", "turn"]
            {
                assert!(!words.contains(mechanical), "{}: {words}", mechanism.kind);
            }
        }
    }

    /// Every way to be wrong, the line it is found on (three stand before the text), and what must be said.
    #[test]
    fn an_excitation_has_a_number_where_its_formula_has_all_its_values() {
        let around = Excitation::Around(greybox_model::parse("1/(2*pi*ta)").unwrap().expr);
        let at = |ta: Option<f64>| around.evaluated(&|name| ta.filter(|_| name == "ta"));
        let Some(Excitation::Around(frequency)) = at(Some(0.05)) else { panic!("no frequency") };
        assert!((frequency - 10.0 / std::f64::consts::PI).abs() < 1e-12, "{frequency}");
        assert_eq!([at(None), at(Some(-0.05)), at(Some(0.0))], [None; 3]);
        assert_eq!(Excitation::Slow.evaluated(&|_| None), Some(Excitation::Slow));
    }

    #[test]
    fn wrong_files_are_refused_with_line_and_help() {
        let state = "force = \"k*z\"\nlinear = [\"k\"]\n[states.z]\n";
        let first = "force = \"fc*sign(d')\"\nlinear = [\"a\"]\n";
        let rows: &[(&str, usize, &str)] = &[
            // not TOML, unknown keys and sections, wrong types
            ("force = \"d", 4, "invalid basic string"),
            ("force = \"d\"\ncolour = 1", 5, "unknown field `colour`, expected one of"),
            ("force = \"d\"\nlinear = \"fc\"", 5, "expected a sequence"),
            ("force = \"d\"\ndomain = \"thermal\"", 5, "unknown variant `thermal`, expected `mechanical`"),
            ("force = \"d\"\n[about]\nseperate = \"\"", 6, "unknown field `seperate`"),
            ("force = \"d\"\n[location]\nwhere = \"d\"", 6, "unknown field `where`"),
            // the law
            ("linear = [\"fc\"]", 0, "has `force`"),
            ("replace = \"d\"", 4, "has `force`"),
            ("force = \"d\"\nreplace = \"d\"", 4, "none has both"),
            ("force = \"d\"\nreaction = \"d\"", 5, "only a mechanism on a pair"),
            ("named = false\nforce = \"k*d*t\"\nlinear = [\"k\"]", 4, "a law without a name is a force"),
            ("force = \"shape\"\n[shape]\nof = \"d\"", 6, "a law of free shape has `named = false`"),
            (
                "named = false\nforce = \"d\"\n[shape]\nof = \"d\"",
                7,
                "writes `shape` where the function stands",
            ),
            ("named = false\nforce = \"shape\"\n[shape]\nof = \"q\"", 5, "the law uses `q`"),
            ("force = \"fc*sign(d'\"\nlinear = [\"fc\"]", 4, "`force = \"fc*sign(d'\"`"),
            ("force = \"fc*sgn(d')\"\nlinear = [\"fc\"]", 4, "sgn"),
            ("force = \"fc*sign(d')\"", 4, "the law uses `fc`, which is neither a parameter"),
            ("force = \"fc*u\"\nlinear = [\"fc\"]", 4, "the law uses `u`"),
            // parameters
            ("force = \"fc^2*d\"\nlinear = [\"fc\"]", 5, "not linear in it; list it under [inner]"),
            ("force = \"d\"\nlinear = [\"q\"]", 5, "does not use `q`"),
            ("force = \"d\"\npositive = [\"q\"]", 5, "`positive` names `q`"),
            ("force = \"fc*d\"\nlinear = [\"fc\", \"fc\"]", 5, "`fc` is listed twice"),
            ("force = \"d*t\"\nlinear = [\"t\"]", 5, "`t` already means something"),
            ("force = \"fc*d\"\nlinear = [\"f c\"]", 5, "`f c` is no name"),
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\nrequire = [\"fc - q\"]",
                6,
                "`require`: `q` is no parameter",
            ),
            ("force = \"fc*d\"\nlinear = [\"fc\"]\nsurcharge = -1", 6, "`surcharge` must be"),
            // [inner]
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [1.0], scale = \"mean(d)\" }",
                7,
                "unknown scale function `mean`",
            ),
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [1.0], scale = \"big\" }",
                7,
                "scale `big` is none of",
            ),
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [1.0], scale = \"rms(v)\" }",
                7,
                "`v` is no channel of this law",
            ),
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [] }",
                7,
                "`grid` must list finite first values",
            ),
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [nan] }",
                7,
                "`grid` must list finite first values",
            ),
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [5], high = 1 }",
                7,
                "must enclose the grid",
            ),
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [5], carrier = \"d\" }",
                7,
                "`carrier` is what a law with a `spectral` variable is multiplied by",
            ),
            (
                "force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [5], scal = \"1\" }",
                7,
                "unknown field `scal`",
            ),
            // [states]
            (&format!("{state}equation = \"z' = d' -\"\nunit = \"d\""), 7, "equation"),
            (&format!("{state}equation = \"z' + d'\"\nunit = \"d\""), 7, "="),
            (&format!("{state}equation = \"d' = d\"\nunit = \"d\""), 7, "does not mention `z`"),
            (&format!("{state}equation = \"z = d\"\nunit = \"d\""), 7, "holds no derivative of `z`"),
            (
                &format!("{state}equation = \"z'^2 = d'\"\nunit = \"d\""),
                7,
                "linear in its highest derivative, `z'`",
            ),
            (&format!("{state}equation = \"z' = q*d'\"\nunit = \"d\""), 7, "the equation uses `q`"),
            (&format!("{state}equation = \"z' = k*d'\"\nunit = \"d\""), 5, "reach it through `[first]`"),
            (&format!("{state}equation = \"z' = d'\"\nunit = \"m\""), 8, "`unit`: `m` is none of d, t, pi"),
            (
                &format!("{state}equation = \"z' = d'\"\nunit = \"d\"\nstart = [\"q\"]"),
                9,
                "`start`: `q` is none of",
            ),
            (&format!("{state}equation = \"z' = d'\""), 6, "missing field `unit`"),
            // [first]
            (&format!("{first}[first]\nfc = \"q\""), 7, "`q` is neither under `linear` nor under `[inner]`"),
            (&format!("{first}[first]\nfc = \"a\"\nq = \"a\""), 8, "the law does not use `q`"),
            (&format!("{first}[first]\nfc = 3"), 7, "write the formula as a string"),
            (&format!("{first}[first]\nfc = \"a^2\""), 5, "through `[first]` the law is not linear in a"),
            (
                "force = \"fc*z\"\nlinear = [\"a\"]\n[states.z]\nequation = \"z' = d' - fc*z\"\nunit = \"d\"\n[first]\nfc = \"a\"",
                5,
                "the equation of the state `z` depends on a",
            ),
            // [location], [experiment], [report], [equals]
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\n[experiment]\ndrive = \"around\"\nat = \"1/q\"",
                8,
                "[experiment] at: `q` is no parameter",
            ),
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\n[experiment]\ndrive = \"ramp\"",
                7,
                "[experiment] drive: state the frequency",
            ),
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\n[experiment]\ndrive = \"slow\"\nat = \"fc\"",
                8,
                "[experiment] at: only `around`",
            ),
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\n[location]\nvariable = \"v\"",
                7,
                "[location] variable: `v`",
            ),
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\n[location]\nvariable = \"d'\"\nlow = \"-2*vs\"",
                8,
                "[location] low: `vs` is no parameter",
            ),
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\n[report]\nf0 = \"sqrt(q)\"",
                7,
                "[report] f0: `q` is no parameter",
            ),
            (
                "force = \"fc*d\"\nlinear = [\"fc\"]\n[equals]\nlinear_stiffness = { kg = \"q\" }",
                7,
                "[equals] linear_stiffness: `q` is no parameter",
            ),
        ];
        for (rest, line, part) in rows {
            let about =
                if rest.contains("[about]") || *line == 4 && part.starts_with("inv") { "" } else { TAIL };
            let (found, message) = error(&format!("{rest}{about}"));
            assert!(message.contains(part), "`{part}` is not in `{message}` for:\n{rest}");
            assert_eq!(found, (*line > 0).then_some(*line), "`{message}` for:\n{rest}");
        }
    }

    #[test]
    fn a_library_is_put_together() {
        let file = |rest: &str| format!("{HEAD}force = \"fc*sign(d')\"\nlinear = [\"fc\"]\n{rest}{TAIL}");
        let own = |name: &str, text: String| combine(&[(name.to_string(), text)]);
        let library = own("k.toml", file("")).unwrap();
        let count = BUILT_IN.len();
        assert_eq!(
            (library.mechanisms.len(), library.added.len(), library.replaced.len()),
            (count + 1, 1, 0)
        );
        // The name and the kind of a built-in file: it is replaced, in its place.
        let text = file("").replace("\"k\"", "\"coulomb_friction\"");
        let library = own("coulomb_friction.toml", text.clone()).unwrap();
        assert_eq!(
            (library.mechanisms.len(), library.replaced.as_slice()),
            (count, &["coulomb_friction.toml".to_string()][..])
        );
        let place = BUILT_IN.iter().position(|f| f.0 == "coulomb_friction.toml").unwrap();
        assert_eq!(library.mechanisms[place].family, "f");
        assert_eq!(own("mine.toml", text).unwrap().replaced.len(), 0, "another form of the kind");
        for (rest, line, part) in [
            (
                "refines = [\"coulomb\"]",
                6,
                "`refines` names `coulomb`, a kind that the library does not have",
            ),
            ("doubts = [\"coulomb\"]", 6, "`doubts` names `coulomb`, a kind that the library does not have"),
            ("[equals]\ncoulomb = { fc = \"fc\" }", 7, "[equals] names `coulomb`"),
            ("[equals]\ncoulomb_friction = { fs = \"fc\" }", 7, "it has no parameter `fs`"),
            ("[special_case]\nbouc = { kh = \"fc\" }", 7, "[special_case] names `bouc`"),
            (
                "[special_case]\nstribeck_friction = { fc = \"fc\", fs = \"2*fc\", vs = \"1\" }",
                7,
                "not those of",
            ),
        ] {
            let e = own("x.toml", file(rest)).unwrap_err();
            assert!(e.message.contains(part), "{e}");
            assert_eq!((e.line, e.file.as_str()), (Some(line), "x.toml"), "{e}");
        }
        // A kind of one's own may be refined by another.
        let files = [
            ("a.toml".to_string(), file("refines = [\"j\"]")),
            ("b.toml".to_string(), file("").replace("\"k\"", "\"j\"")),
        ];
        assert_eq!(combine(&files).unwrap().added, ["a.toml", "b.toml"]);
    }

    #[test]
    fn a_refinement_is_its_law_at_equal_strengths() {
        let library = built_in().unwrap();
        let law = |kind: &str| library.iter().find(|m| m.kind == kind).unwrap();
        let at_equal = |law: &Mechanism| -> Vec<&str> {
            library.iter().filter(|m| m.is_at_equal_strengths(law)).map(|m| m.kind.as_str()).collect()
        };
        let coulomb = at_equal(law("coulomb_friction"));
        assert_eq!(coulomb, ["asymmetric_coulomb_friction", "coulomb_friction", "stribeck_friction"]);
        // A law of two strengths has none that theirs could equal.
        assert!(at_equal(law("stribeck_friction")).is_empty());
        assert_eq!(at_equal(law("quadratic_drag")), ["quadratic_drag"]);
    }

    #[test]
    fn constants_of_a_law_do_not_vanish_with_its_force() {
        let library = built_in().unwrap();
        let vanish = |kind: &str| {
            library.iter().find(|m| m.kind == kind).map(Mechanism::vanish_with_force).unwrap_or_default()
        };
        assert_eq!(vanish("presliding_friction"), [true, true]);
        assert_eq!(vanish("bouc_wen_hysteresis"), [true, false, false]);
        assert_eq!(vanish("stribeck_friction"), [true, true, false]);
        // (ncg, acg and pcg.)
        assert_eq!(vanish("cogging"), [false, true, false]);
        assert_eq!(vanish("unmodeled_resonance"), [true, true, true]);
        assert_eq!(vanish("input_saturation"), [true]);
    }

    #[test]
    fn a_hysteresis_dissipates() {
        let library = built_in().unwrap();
        let hysteresis = library.iter().find(|m| m.kind == "bouc_wen_hysteresis").unwrap();
        let holds = |be: f64, ga: f64| {
            let value = |n: &str| if n == "be" { be } else { ga };
            hysteresis.require.iter().all(|e| e.eval(&|n, _| Some(value(n))).unwrap() >= 0.0)
        };
        // The published benchmark (Noël, Schoukens 2016) hardens more than it dissipates; a spring only hardens.
        assert!(holds(800.0, -1100.0) && holds(30.0, 30.0) && holds(5.0, 0.0));
        assert!(!holds(0.15, -108.0) && !holds(0.05, -45.5));
    }
}
