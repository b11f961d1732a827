//! Run-time units: a dimension (exponents of the SI base units and of those that the model declares), a
//! factor and an offset to SI, and the text as the user wrote it. Radians and counts are dimensionless, as
//! textbooks mix `N m` and `N m/rad` freely.
//!
//! ```text
//! unit   = factor {["*" | "·" | "/"] factor}      a space multiplies; "/" divides by the next factor only
//! factor = (symbol | "1" | "(" unit ")") ["^" exponent]
//! ```
//!
//! # Temperatures
//! `degC` and `degF` alone are absolute temperatures, with a zero of their own. In a product they are
//! differences, as in `W/degC`.
//!
//! # Units of a model
//! A model declares further symbols under `[units]` ([`Units`]): a multiple of a known unit, or a dimension
//! of its own.

use crate::nearest::nearest;
use crate::parse::parse;
use std::f64::consts::PI;
use std::fmt;
use std::ops::{Div, Mul, Range};

/// Longest symbol of a dimension that a model declares, bytes of UTF-8.
pub(crate) const LONGEST_SYMBOL: usize = 15;

/// The symbol of a dimension that a model declares.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Symbol {
    bytes: [u8; LONGEST_SYMBOL],
    length: u8,
}

impl Symbol {
    const EMPTY: Symbol = Symbol { bytes: [0; LONGEST_SYMBOL], length: 0 };

    /// `None` where it is too long.
    fn new(text: &str) -> Option<Symbol> {
        let mut symbol = Symbol { length: u8::try_from(text.len()).ok()?, ..Symbol::EMPTY };
        symbol.bytes.get_mut(..text.len())?.copy_from_slice(text.as_bytes());
        Some(symbol)
    }

    fn as_str(&self) -> &str {
        self.bytes.get(..usize::from(self.length)).and_then(|b| std::str::from_utf8(b).ok()).unwrap_or("")
    }
}

/// Exponents of the SI base units m, kg, s, A, K, mol, cd, and of up to [`Dimension::MOST_DECLARED`] dimensions
/// that a model declares.
#[derive(Clone, Copy)]
pub struct Dimension {
    si: [f64; 7],
    /// Free where the exponent is zero.
    declared: [(Symbol, f64); Dimension::MOST_DECLARED],
}

/// A unit as written, with its meaning: `SI value = factor * value + offset`.
#[derive(Debug, Clone, PartialEq)]
pub struct Unit {
    /// As the user wrote it, e.g. `N m/V`.
    pub text: String,
    /// SI value of a difference of one of this unit (`mm` → 1e-3, `deg` → π/180, `degF` → 5/9).
    pub factor: f64,
    /// SI value of zero of this unit: 273.15 K for `degC`, 0 for every unit but absolute temperatures.
    pub offset: f64,
    /// Its dimension.
    pub dimension: Dimension,
}

/// Text that is not a unit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}{}", .help.as_ref().map(|h| format!("; help: {h}")).unwrap_or_default())]
pub struct UnitError {
    /// The offending token, in bytes of the unit's text.
    pub span: Range<usize>,
    /// What is wrong.
    pub message: String,
    /// How to fix it.
    pub help: Option<String>,
    /// The symbol, where it is one that is not known. Another model may declare it.
    pub unknown: Option<String>,
}

const fn dim(m: f64, kg: f64, s: f64, a: f64) -> Dimension {
    Dimension::from_si([m, kg, s, a, 0.0, 0.0, 0.0])
}

/// Symbols of the SI base units in the order of [`Dimension`].
const BASE: [&str; 7] = ["m", "kg", "s", "A", "K", "mol", "cd"];

/// m/s², m and kg, exact by definition.
const STANDARD_GRAVITY: f64 = 9.80665;
const INCH: f64 = 0.0254;
const POUND: f64 = 0.453_592_37;

/// symbol, factor to SI, dimension, whether SI prefixes may stand before it
const SYMBOLS: &[(&str, f64, Dimension, bool)] = &[
    ("m", 1.0, dim(1.0, 0.0, 0.0, 0.0), true),
    ("kg", 1.0, dim(0.0, 1.0, 0.0, 0.0), false),
    ("g", 1e-3, dim(0.0, 1.0, 0.0, 0.0), true),
    ("s", 1.0, dim(0.0, 0.0, 1.0, 0.0), true),
    ("A", 1.0, dim(0.0, 0.0, 0.0, 1.0), true),
    ("K", 1.0, Dimension::TEMPERATURE, true),
    ("mol", 1.0, Dimension::from_si([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]), true),
    ("cd", 1.0, Dimension::from_si([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), true),
    ("rad", 1.0, dim(0.0, 0.0, 0.0, 0.0), true),
    ("sr", 1.0, dim(0.0, 0.0, 0.0, 0.0), true),
    ("N", 1.0, dim(1.0, 1.0, -2.0, 0.0), true),
    ("J", 1.0, dim(2.0, 1.0, -2.0, 0.0), true),
    ("W", 1.0, dim(2.0, 1.0, -3.0, 0.0), true),
    ("Pa", 1.0, dim(-1.0, 1.0, -2.0, 0.0), true),
    ("Hz", 1.0, dim(0.0, 0.0, -1.0, 0.0), true),
    ("V", 1.0, dim(2.0, 1.0, -3.0, -1.0), true),
    ("Ohm", 1.0, dim(2.0, 1.0, -3.0, -2.0), true),
    ("ohm", 1.0, dim(2.0, 1.0, -3.0, -2.0), true),
    ("\u{3a9}", 1.0, dim(2.0, 1.0, -3.0, -2.0), true),
    ("\u{2126}", 1.0, dim(2.0, 1.0, -3.0, -2.0), true),
    ("F", 1.0, dim(-2.0, -1.0, 4.0, 2.0), true),
    ("H", 1.0, dim(2.0, 1.0, -2.0, -2.0), true),
    ("T", 1.0, dim(0.0, 1.0, -2.0, -1.0), true),
    ("Wb", 1.0, dim(2.0, 1.0, -2.0, -1.0), true),
    ("C", 1.0, dim(0.0, 0.0, 1.0, 1.0), true),
    ("S", 1.0, dim(-2.0, -1.0, 3.0, 2.0), true),
    ("deg", PI / 180.0, dim(0.0, 0.0, 0.0, 0.0), false),
    ("\u{b0}", PI / 180.0, dim(0.0, 0.0, 0.0, 0.0), false),
    ("rev", 2.0 * PI, dim(0.0, 0.0, 0.0, 0.0), false),
    ("rpm", PI / 30.0, dim(0.0, 0.0, -1.0, 0.0), false),
    ("rps", 2.0 * PI, dim(0.0, 0.0, -1.0, 0.0), false),
    ("arcmin", PI / 10_800.0, dim(0.0, 0.0, 0.0, 0.0), false),
    ("arcsec", PI / 648_000.0, dim(0.0, 0.0, 0.0, 0.0), false),
    ("%", 1e-2, dim(0.0, 0.0, 0.0, 0.0), false),
    ("min", 60.0, dim(0.0, 0.0, 1.0, 0.0), false),
    ("h", 3600.0, dim(0.0, 0.0, 1.0, 0.0), false),
    ("bar", 1e5, dim(-1.0, 1.0, -2.0, 0.0), true),
    ("L", 1e-3, dim(3.0, 0.0, 0.0, 0.0), true),
    ("l", 1e-3, dim(3.0, 0.0, 0.0, 0.0), true),
    // What test rigs are labelled with besides SI; `gn` is the standard gravity of accelerometers.
    ("gn", STANDARD_GRAVITY, dim(1.0, 0.0, -2.0, 0.0), false),
    ("kgf", STANDARD_GRAVITY, dim(1.0, 1.0, -2.0, 0.0), false),
    ("atm", 101_325.0, dim(-1.0, 1.0, -2.0, 0.0), false),
    ("in", INCH, dim(1.0, 0.0, 0.0, 0.0), false),
    ("ft", 12.0 * INCH, dim(1.0, 0.0, 0.0, 0.0), false),
    ("lbf", POUND * STANDARD_GRAVITY, dim(1.0, 1.0, -2.0, 0.0), false),
    ("psi", POUND * STANDARD_GRAVITY / (INCH * INCH), dim(-1.0, 1.0, -2.0, 0.0), false),
    // What converters, encoders, cameras and stepper drives count.
    ("count", 1.0, Dimension::NONE, false),
    ("counts", 1.0, Dimension::NONE, false),
    ("LSB", 1.0, Dimension::NONE, false),
    ("px", 1.0, Dimension::NONE, false),
    ("step", 1.0, Dimension::NONE, false),
    ("tick", 1.0, Dimension::NONE, false),
    ("pulse", 1.0, Dimension::NONE, false),
    // Differences of temperature; alone they are absolute, see `OFFSETS`.
    ("degC", 1.0, Dimension::TEMPERATURE, false),
    ("\u{b0}C", 1.0, Dimension::TEMPERATURE, false),
    ("\u{2103}", 1.0, Dimension::TEMPERATURE, false),
    ("degF", RANKINE, Dimension::TEMPERATURE, false),
    ("\u{b0}F", RANKINE, Dimension::TEMPERATURE, false),
    ("\u{2109}", RANKINE, Dimension::TEMPERATURE, false),
];

/// K, exact by definition: the zero of the Celsius scale, a degree and the zero of the Fahrenheit scale.
const ZERO_CELSIUS: f64 = 273.15;
const RANKINE: f64 = 5.0 / 9.0;
const ZERO_FAHRENHEIT: f64 = 459.67 * RANKINE;

/// What stands alone as a unit with a zero of its own, and the SI value of that zero.
const OFFSETS: [(&str, f64); 6] = [
    ("degC", ZERO_CELSIUS),
    ("\u{b0}C", ZERO_CELSIUS),
    ("\u{2103}", ZERO_CELSIUS),
    ("degF", ZERO_FAHRENHEIT),
    ("\u{b0}F", ZERO_FAHRENHEIT),
    ("\u{2109}", ZERO_FAHRENHEIT),
];

const PREFIXES: &[(&str, f64)] = &[
    ("T", 1e12),
    ("G", 1e9),
    ("M", 1e6),
    ("k", 1e3),
    ("h", 1e2),
    ("da", 1e1),
    ("d", 1e-1),
    ("c", 1e-2),
    ("m", 1e-3),
    ("\u{b5}", 1e-6),
    ("\u{3bc}", 1e-6),
    ("u", 1e-6),
    ("n", 1e-9),
    ("p", 1e-12),
    ("f", 1e-15),
];

/// Deepest nesting of parentheses in a unit.
const MAX_NESTING: usize = 16;

/// Largest magnitude of an exponent, as written and of a base unit in the whole.
const MAX_EXPONENT: f64 = 100.0;

impl Dimension {
    /// Most dimensions of its own that a model may declare.
    pub const MOST_DECLARED: usize = 4;
    /// No dimension.
    pub const NONE: Dimension = Dimension::from_si([0.0; 7]);
    /// Time.
    pub const TIME: Dimension = dim(0.0, 0.0, 1.0, 0.0);
    /// Temperature.
    pub const TEMPERATURE: Dimension = Dimension::from_si([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);

    /// The dimension of these exponents of m, kg, s, A, K, mol, cd.
    ///
    /// ```
    /// use greybox_model::{Dimension, Unit};
    /// let force = Dimension::from_si([1.0, 1.0, -2.0, 0.0, 0.0, 0.0, 0.0]);
    /// assert_eq!(force, Unit::parse("N")?.dimension);
    /// assert_eq!(force.to_string(), "N");
    /// # Ok::<(), greybox_model::UnitError>(())
    /// ```
    pub const fn from_si(exponents: [f64; 7]) -> Dimension {
        Dimension { si: exponents, declared: [(Symbol::EMPTY, 0.0); Dimension::MOST_DECLARED] }
    }

    /// The dimension that a model declares under this symbol; `None` where the symbol is too long.
    fn own(symbol: &str) -> Option<Dimension> {
        let mut own = Dimension::NONE;
        own.declared[0] = (Symbol::new(symbol)?, 1.0);
        Some(own)
    }

    /// Exponents of m, kg, s, A, K, mol, cd.
    pub fn si_exponents(&self) -> [f64; 7] {
        self.si
    }

    /// Symbols and exponents of the declared dimensions in it, those that are not zero.
    pub fn declared(&self) -> impl Iterator<Item = (&str, f64)> {
        self.declared.iter().filter(|(_, e)| *e != 0.0).map(|(symbol, e)| (symbol.as_str(), *e))
    }

    fn exponent_of(&self, symbol: &Symbol) -> f64 {
        self.declared.iter().find(|(s, e)| s == symbol && *e != 0.0).map_or(0.0, |(_, e)| *e)
    }

    /// Whether a test holds of all pairs of exponents.
    fn all(&self, other: &Dimension, test: impl Fn(f64, f64) -> bool) -> bool {
        let symbols = self.declared.iter().chain(&other.declared).filter(|(_, e)| *e != 0.0);
        self.si.iter().zip(other.si).all(|(a, b)| test(*a, b))
            && symbols.map(|(s, _)| s).all(|s| test(self.exponent_of(s), other.exponent_of(s)))
    }

    /// Whether both are equal up to rounding of fractional exponents (1e-9).
    pub fn same(&self, other: &Dimension) -> bool {
        self.all(other, |a, b| (a - b).abs() < 1e-9)
    }

    /// Whether it is [`Dimension::NONE`] up to rounding.
    pub fn is_none(&self) -> bool {
        self.same(&Dimension::NONE)
    }

    /// Every exponent times `exponent`.
    pub fn pow(self, exponent: f64) -> Dimension {
        self.map(|e| e * exponent)
    }

    fn map(self, change: impl Fn(f64) -> f64) -> Dimension {
        Dimension { si: self.si.map(&change), declared: self.declared.map(|(s, e)| (s, change(e))) }
    }

    /// Exponents plus `scale` times those of the other. More declared dimensions than there is room for, which no
    /// model has, make one that is the same as no other.
    fn plus(self, other: Dimension, scale: f64) -> Dimension {
        let mut sum = self;
        for (own, e) in sum.si.iter_mut().zip(other.si) {
            *own += scale * e;
        }
        for (symbol, e) in other.declared.iter().filter(|(_, e)| *e != 0.0) {
            let slot = sum.declared.iter().position(|(s, e)| s == symbol && *e != 0.0);
            match slot.or_else(|| sum.declared.iter().position(|(_, e)| *e == 0.0)) {
                Some(i) if slot.is_some() => sum.declared[i].1 += scale * e,
                Some(i) => sum.declared[i] = (*symbol, scale * e),
                None => sum.si = [f64::NAN; 7],
            }
        }
        sum
    }
}

impl Default for Dimension {
    fn default() -> Self {
        Dimension::NONE
    }
}

impl PartialEq for Dimension {
    fn eq(&self, other: &Self) -> bool {
        self.all(other, |a, b| a == b)
    }
}

impl fmt::Debug for Dimension {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Dimension({self})")
    }
}

impl Mul for Dimension {
    type Output = Dimension;
    fn mul(self, other: Dimension) -> Dimension {
        self.plus(other, 1.0)
    }
}

impl Div for Dimension {
    type Output = Dimension;
    fn div(self, other: Dimension) -> Dimension {
        self.plus(other, -1.0)
    }
}

/// The SI unit of this dimension as [`Unit::si`] writes it.
impl fmt::Display for Dimension {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&si_text(*self))
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl Unit {
    /// The unit `1`.
    pub fn dimensionless() -> Unit {
        Unit { text: "1".into(), factor: 1.0, offset: 0.0, dimension: Dimension::NONE }
    }

    /// The SI unit of a dimension, written readably: mechanical and electrical derived units where
    /// they make it shorter (`N m`, `N s/m`, `V^0.5/s`), base units else (`kg m^2`). Its text parses
    /// back to the same dimension with factor 1.
    pub fn si(dimension: Dimension) -> Unit {
        Unit { text: si_text(dimension), factor: 1.0, offset: 0.0, dimension }
    }

    /// Parses a unit as engineers write it, with the built-in symbols; [`Units::parse`] knows those of a model as
    /// well.
    ///
    /// `/` divides by the next factor only: `N/m s` is (N/m)·s, and `N/(m s)` or `N/m/s` divides by
    /// both. `rad`, `sr`, `count`, `LSB`, `px`, `step`, `tick`, `pulse` and `1` are dimensionless with factor 1, `%`
    /// is 0.01, `deg` π/180, `rpm` π/30 s⁻¹, `Hz` 1 s⁻¹. Superscript digits are accepted. `degC` and `degF` alone
    /// have an offset.
    ///
    /// ```
    /// use greybox_model::Unit;
    /// let kt = Unit::parse("N*m/A")?;
    /// assert_eq!(kt.dimension, Unit::parse("V s")?.dimension);
    /// assert_eq!(Unit::parse("mm")?.factor, 1e-3);
    /// assert_eq!(Unit::parse("count/rev")?.dimension, Unit::parse("1")?.dimension);
    ///
    /// let celsius = Unit::parse("degC")?;
    /// assert_eq!(celsius.to_si(20.0), 293.15);
    /// assert_eq!(celsius.difference_to_si(20.0), 20.0);
    /// assert_eq!(Unit::parse("W/degC")?, greybox_model::Unit { text: "W/degC".into(), ..Unit::parse("W/K")? });
    /// # Ok::<(), greybox_model::UnitError>(())
    /// ```
    ///
    /// # Errors
    /// [`UnitError`] names the offending token and its fix.
    pub fn parse(text: &str) -> Result<Unit, UnitError> {
        Units::default().parse(text)
    }

    /// The SI value of a value in this unit.
    pub fn to_si(&self, value: f64) -> f64 {
        // Adding zero would take the sign of a negative zero.
        if self.offset == 0.0 { value * self.factor } else { value * self.factor + self.offset }
    }

    /// The value in this unit of an SI value.
    pub fn from_si(&self, si: f64) -> f64 {
        if self.offset == 0.0 { si / self.factor } else { (si - self.offset) / self.factor }
    }

    /// The SI value of a start value of a state in this unit (`primes` 0), or of a derivative of it.
    pub(crate) fn initial_to_si(&self, primes: usize, value: f64) -> f64 {
        if primes == 0 { self.to_si(value) } else { self.difference_to_si(value) }
    }

    /// The SI value of a difference of two values in this unit: of a standard deviation, an error, a step.
    pub fn difference_to_si(&self, difference: f64) -> f64 {
        difference * self.factor
    }

    /// The unit of differences in this unit: the same, without its zero.
    pub fn of_difference(&self) -> Unit {
        Unit { offset: 0.0, ..self.clone() }
    }

    /// The difference in this unit of two SI values that differ by `si`.
    pub fn difference_from_si(&self, si: f64) -> f64 {
        si / self.factor
    }
}

/// The units that a model declares under `[units]`, in the order of the file.
///
/// ```
/// use greybox_model::Model;
/// let model = Model::from_toml(r#"
///     [units]
///     enc = "2*pi/4096 rad"      # a multiple of a known unit
///     dose = "own"               # a dimension of its own
///     [inputs]
///     u = { unit = "dose/s" }
///     [states]
///     theta = { unit = "enc" }
///     c = { unit = "dose" }
///     [parameters]
///     T = { value = 0.5, unit = "s" }
///     k = { value = 3, unit = "enc/dose" }
///     [equations]
///     uptake = "c' = u - c/T"
///     turn = "T*theta' + theta = k*c"
/// "#, "uptake.toml")?;
/// let enc = model.units.parse("enc")?;
/// assert!((enc.factor - std::f64::consts::TAU / 4096.0).abs() < 1e-18);
/// assert_eq!(model.units.parse("dose/s")?.dimension.to_string(), "dose/s");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Units {
    declared: Vec<DeclaredUnit>,
}

/// A symbol under `[units]`.
#[derive(Debug, Clone, PartialEq)]
pub struct DeclaredUnit {
    /// The symbol.
    pub symbol: String,
    /// What it stands for: `own`, or a number and a unit.
    pub definition: String,
    /// Its meaning; the text is the symbol.
    pub unit: Unit,
}

impl Units {
    /// Parses a unit with the built-in symbols and those declared here.
    ///
    /// # Errors
    /// As [`Unit::parse`].
    pub fn parse(&self, text: &str) -> Result<Unit, UnitError> {
        let mut parser = UnitParser { text, position: 0, units: self };
        if text.trim().is_empty() {
            return Err(unit_error(
                0..text.len(),
                "the unit is empty",
                Some("write `1` for a dimensionless value"),
            ));
        }
        let (factor, dimension) = parser.product(0)?;
        if let Some(c) = parser.next_char() {
            let help =
                if c == ')' { "remove it, or add the missing `(`" } else { "write units like `N m/(rad/s)`" };
            return Err(unit_error(
                parser.position..parser.position + c.len_utf8(),
                format!("found `{c}`"),
                Some(help),
            ));
        }
        usable(text, factor, dimension)?;
        let text = text.trim().to_owned();
        let offset = self.offset(&text);
        Ok(Unit { text, factor, offset, dimension })
    }

    /// The declared symbols.
    pub fn iter(&self) -> impl Iterator<Item = &DeclaredUnit> {
        self.declared.iter()
    }

    /// SI value of the zero of a symbol that stands alone.
    fn offset(&self, symbol: &str) -> f64 {
        let declared = self.declared.iter().find(|d| d.symbol == symbol);
        let known = OFFSETS.iter().find(|(s, _)| *s == symbol);
        declared.map(|d| d.unit.offset).or(known.map(|(_, offset)| *offset)).unwrap_or(0.0)
    }

    fn lookup(&self, symbol: &str) -> Option<(f64, Dimension)> {
        let declared = self.declared.iter().find(|d| d.symbol == symbol);
        declared.map(|d| (d.unit.factor, d.unit.dimension)).or_else(|| lookup(symbol))
    }

    /// Adds a symbol, whose name has been checked, with what it stands for.
    pub(crate) fn declare(&mut self, symbol: &str, definition: &str) -> Result<(), UnitError> {
        let unit = self.defined(symbol, definition)?;
        self.declared.push(DeclaredUnit {
            symbol: symbol.to_owned(),
            definition: definition.trim().to_owned(),
            unit,
        });
        Ok(())
    }

    fn defined(&self, symbol: &str, definition: &str) -> Result<Unit, UnitError> {
        let whole = 0..definition.len();
        if definition.trim() == OWN {
            if self.declared.iter().filter(|d| d.definition == OWN).count() >= Dimension::MOST_DECLARED {
                let most = Dimension::MOST_DECLARED;
                let help = "make it a multiple of a known unit, such as `1` or one of the other symbols";
                let message = format!("a model may declare at most {most} dimensions of its own");
                return Err(unit_error(whole, message, Some(help)));
            }
            let Some(dimension) = Dimension::own(symbol) else {
                let message = format!("a dimension's symbol is no longer than {LONGEST_SYMBOL} bytes");
                return Err(unit_error(whole, message, Some("choose a shorter symbol")));
            };
            return Ok(Unit { text: symbol.to_owned(), factor: 1.0, offset: 0.0, dimension });
        }
        // The shortest number behind which the rest is a unit; else the error of the longest.
        let mut fault = None;
        let ends = definition.char_indices().filter(|(_, c)| c.is_whitespace()).map(|(i, _)| i);
        for end in ends.chain([definition.len()]) {
            let (number, rest) = definition.split_at(end);
            let constant = parse(number).ok().and_then(|p| p.expr.eval(&constant));
            let Some(value) = constant else { continue };
            if !(value.is_finite() && value > 0.0) {
                let message = format!("a unit is a positive multiple of another, found {value}");
                return Err(unit_error(0..end, message, Some("write a positive number before the unit")));
            }
            match if rest.trim().is_empty() { Ok(Unit::dimensionless()) } else { self.parse(rest) } {
                Ok(of) => {
                    let factor = value * of.factor;
                    usable(definition, factor, of.dimension)?;
                    return Ok(Unit {
                        text: symbol.to_owned(),
                        factor,
                        offset: 0.0,
                        dimension: of.dimension,
                    });
                }
                Err(e) => fault = Some(UnitError { span: e.span.start + end..e.span.end + end, ..e }),
            }
        }
        match (self.parse(definition), fault) {
            (Ok(of), _) => Ok(Unit { text: symbol.to_owned(), ..of }),
            (Err(_), Some(fault)) => Err(fault),
            (Err(fault), None) => Err(fault),
        }
    }
}

/// What a dimension of its own is declared as.
pub(crate) const OWN: &str = "own";

/// The names of a number in a definition.
fn constant(name: &str, primes: u8) -> Option<f64> {
    (name == "pi" && primes == 0).then_some(PI)
}

/// Why a symbol cannot be declared under `[units]`, and what to do.
pub(crate) fn refused_symbol(symbol: &str) -> Option<(String, String)> {
    if lookup(symbol).is_some() || symbol == OWN {
        let reason = if symbol == OWN {
            "the word declares a dimension".to_owned()
        } else {
            "it is a built-in unit".to_owned()
        };
        return Some((reason, format!("choose another symbol, such as `{symbol}_`")));
    }
    if symbol.is_empty() || !symbol.chars().all(|c| c.is_alphabetic() || c == '_') {
        let letters: String = symbol.chars().filter(|c| c.is_alphabetic() || *c == '_').collect();
        let help = match lookup(&letters) {
            None if !letters.is_empty() => format!("write `{letters}`"),
            _ => "choose a word".to_owned(),
        };
        return Some(("a unit's symbol consists of letters and `_`".to_owned(), help));
    }
    None
}

/// Sees that a unit can be computed with.
fn usable(text: &str, factor: f64, dimension: Dimension) -> Result<(), UnitError> {
    if !(factor.is_finite() && factor > 0.0) {
        return Err(unit_error(
            0..text.len(),
            "the unit's factor to SI overflows",
            Some("use a smaller exponent"),
        ));
    }
    // Within it, the unit can be written in SI and read again.
    let exponents = dimension.si.into_iter().chain(dimension.declared.iter().map(|(_, e)| *e));
    if exponents.into_iter().any(|e| e.abs() > MAX_EXPONENT) {
        return Err(unit_error(
            0..text.len(),
            format!("a base unit stands to a power above {MAX_EXPONENT} in it"),
            Some("use a smaller exponent"),
        ));
    }
    Ok(())
}

fn unit_error(span: Range<usize>, message: impl Into<String>, help: Option<&str>) -> UnitError {
    UnitError { span, message: message.into(), help: help.map(str::to_owned), unknown: None }
}

struct UnitParser<'a> {
    text: &'a str,
    position: usize,
    units: &'a Units,
}

impl UnitParser<'_> {
    /// The next character that is no space, without taking it.
    fn next_char(&mut self) -> Option<char> {
        let rest = &self.text[self.position..];
        let trimmed = rest.trim_start();
        self.position += rest.len() - trimmed.len();
        trimmed.chars().next()
    }

    /// Takes characters while `wanted` holds and gives their range.
    fn take(&mut self, wanted: impl Fn(char) -> bool) -> Range<usize> {
        let rest = &self.text[self.position..];
        let length = rest.find(|c| !wanted(c)).unwrap_or(rest.len());
        let start = self.position;
        self.position += length;
        start..self.position
    }

    fn product(&mut self, nesting: usize) -> Result<(f64, Dimension), UnitError> {
        let (mut factor, mut dimension) = self.power(nesting)?;
        loop {
            let divide = match self.next_char() {
                None | Some(')') => return Ok((factor, dimension)),
                Some('*') if self.text[self.position..].starts_with("**") => {
                    let span = self.position..self.position + 2;
                    return Err(unit_error(span, "found `**`", Some("a power is written `^`")));
                }
                Some(c @ ('*' | '\u{b7}' | '\u{22c5}' | '\u{d7}')) => {
                    self.position += c.len_utf8();
                    false
                }
                Some('/') => {
                    self.position += 1;
                    true
                }
                Some(_) => false,
            };
            let (f, d) = self.power(nesting)?;
            (factor, dimension) =
                if divide { (factor / f, dimension / d) } else { (factor * f, dimension * d) };
        }
    }

    fn power(&mut self, nesting: usize) -> Result<(f64, Dimension), UnitError> {
        let (factor, dimension) = self.factor(nesting)?;
        let exponent = self.exponent()?;
        Ok((if exponent == 1.0 { factor } else { factor.powf(exponent) }, dimension.pow(exponent)))
    }

    fn factor(&mut self, nesting: usize) -> Result<(f64, Dimension), UnitError> {
        let Some(c) = self.next_char() else {
            let end = self.text.len();
            return Err(unit_error(
                end..end,
                "found the end, expected a unit",
                Some("write a unit after the operator"),
            ));
        };
        let start = self.position;
        if c == '(' {
            if nesting >= MAX_NESTING {
                return Err(unit_error(start..start + 1, "too many parentheses in the unit", None));
            }
            self.position += 1;
            let inner = self.product(nesting + 1)?;
            if self.next_char() != Some(')') {
                return Err(unit_error(
                    start..start + 1,
                    "this `(` is never closed",
                    Some("add the missing `)`"),
                ));
            }
            self.position += 1;
            return Ok(inner);
        }
        if c.is_ascii_digit() {
            let span = self.take(|c| c.is_ascii_digit() || c == '.' || c == 'e');
            let number = &self.text[span.clone()];
            if number == "1" {
                return Ok((1.0, Dimension::NONE));
            }
            let message = format!("found the number `{number}` in a unit");
            return Err(unit_error(
                span,
                message,
                Some("put it into the value, or use an SI prefix such as `mm`"),
            ));
        }
        let is_letter =
            |c: char| c.is_alphabetic() || matches!(c, '%' | '\u{b0}' | '\u{2103}' | '\u{2109}' | '_');
        let span = self.take(is_letter);
        if span.is_empty() {
            let message = format!("found `{c}`, expected a unit");
            let help = match c {
                '^' => "an exponent stands after a unit, as in `m^2`",
                '[' | ']' => "write the unit without brackets",
                '-' | '\u{2212}' => "write `1` for a dimensionless value, `m^-1` for a negative exponent",
                _ => "write units like `kg m^2`, `N*m/A`, `V^0.5/s`",
            };
            return Err(unit_error(start..start + c.len_utf8(), message, Some(help)));
        }
        let symbol = &self.text[span.clone()];
        let Some(found) = self.units.lookup(symbol) else {
            return Err(UnitError {
                span,
                message: format!("unknown unit `{symbol}`"),
                help: Some(suggestion(symbol, self.units)),
                unknown: Some(symbol.to_owned()),
            });
        };
        // `m2` is a slip for `m^2`; superscripts are taken by `exponent`.
        let digits = self.take(|c| c.is_ascii_digit());
        if !digits.is_empty() {
            let wrong = &self.text[span.start..digits.end];
            let help = format!("write `{symbol}^{}`", &self.text[digits.clone()]);
            return Err(unit_error(span.start..digits.end, format!("unknown unit `{wrong}`"), Some(&help)));
        }
        Ok(found)
    }

    /// `^2`, `^-1`, `^0.5`, `^(1/2)`, `²`; 1 if there is none.
    fn exponent(&mut self) -> Result<f64, UnitError> {
        let superscript = |c: char| {
            "\u{2070}\u{b9}\u{b2}\u{b3}\u{2074}\u{2075}\u{2076}\u{2077}\u{2078}\u{2079}"
                .chars()
                .position(|s| s == c)
        };
        let raised = self.take(|c| c == '\u{207b}' || superscript(c).is_some());
        if !raised.is_empty() {
            let plain: String = self.text[raised.clone()]
                .chars()
                .map(|c| superscript(c).map_or("-".to_owned(), |digit| digit.to_string()))
                .collect();
            return checked_exponent(&plain, raised);
        }
        if self.next_char() != Some('^') {
            return Ok(1.0);
        }
        self.position += 1;
        let parenthesised = self.next_char() == Some('(');
        self.position += usize::from(parenthesised);
        let start = self.position;
        let number = |c: char| c.is_ascii_digit() || matches!(c, '.' | '-' | '+');
        let inside = |c: char| number(c) || matches!(c, '/' | ' ');
        let span = if parenthesised { self.take(inside) } else { self.take(number) };
        let text = &self.text[span.clone()];
        let value = match text.split_once('/') {
            Some((a, b)) => {
                checked_exponent(a.trim(), span.clone())? / checked_exponent(b.trim(), span.clone())?
            }
            None => checked_exponent(text.trim(), span.clone())?,
        };
        if !(value.is_finite() && value.abs() <= MAX_EXPONENT) {
            return Err(unit_error(
                span,
                format!("the exponent `{text}` is not usable"),
                Some("write `m^2` or `V^0.5`"),
            ));
        }
        if parenthesised {
            if self.next_char() != Some(')') {
                return Err(unit_error(
                    start - 1..start,
                    "this `(` is never closed",
                    Some("add the missing `)`"),
                ));
            }
            self.position += 1;
        }
        Ok(value)
    }
}

fn checked_exponent(text: &str, span: Range<usize>) -> Result<f64, UnitError> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v.abs() <= MAX_EXPONENT => Ok(v),
        _ => Err(unit_error(
            span,
            format!("found `{text}`, expected an exponent of at most {MAX_EXPONENT}"),
            Some("write `m^2`, `m^-1`, `V^0.5` or `V^(1/2)`"),
        )),
    }
}

/// Factor and dimension of a symbol, alone or with an SI prefix.
fn lookup(symbol: &str) -> Option<(f64, Dimension)> {
    if let Some((_, factor, dimension, _)) = SYMBOLS.iter().find(|(s, ..)| *s == symbol) {
        return Some((*factor, *dimension));
    }
    PREFIXES.iter().find_map(|(prefix, scale)| {
        let rest = symbol.strip_prefix(prefix)?;
        let (_, factor, dimension, _) = SYMBOLS.iter().find(|(s, _, _, prefixed)| *prefixed && *s == rest)?;
        Some((scale * factor, *dimension))
    })
}

/// Words for units that no rule of spelling leads to.
const MEANT: [(&str, &str); 9] = [
    ("celsius", "degC"),
    ("fahrenheit", "degF"),
    ("kelvin", "K"),
    ("degK", "K"),
    ("\u{b0}K", "K"),
    ("\u{ba}C", "degC"),
    ("\u{ba}F", "degF"),
    ("pixel", "px"),
    ("pixels", "px"),
];

/// What may have been meant by an unknown symbol.
fn suggestion(symbol: &str, units: &Units) -> String {
    if let Some((_, meant)) = MEANT.iter().find(|(slip, _)| slip.eq_ignore_ascii_case(symbol)) {
        return format!("write `{meant}`");
    }
    // `ohms` is a plural, not `ohm s`.
    if let Some(singular) = symbol.strip_suffix('s').filter(|s| s.chars().count() > 1 && lookup(s).is_some())
    {
        return format!("did you mean `{singular}`?");
    }
    let splits = symbol.char_indices().skip(1).map(|(i, _)| symbol.split_at(i));
    for (a, b) in splits {
        if lookup(a).is_some() && lookup(b).is_some() {
            return format!("write `{a} {b}` with a space");
        }
    }
    let common = ["mm", "cm", "km", "ms", "mA", "mV", "kN", "kW", "kHz"];
    let declared = units.declared.iter().map(|d| d.symbol.as_str());
    match nearest(symbol, SYMBOLS.iter().map(|s| s.0).chain(common).chain(declared)) {
        Some(near) => format!("did you mean `{near}`?"),
        None => "use SI units with prefixes (`m kg s A K N J W Pa V Ohm F H T Wb C S Hz`), `rad`, `deg`, `rpm`, `degC`, `count`, `%` or `1`, or declare it under `[units]` of the model".into(),
    }
}

/// Derived units in which a dimension may be printed, best first.
const DERIVED: [(&str, Dimension); 6] = [
    ("N", dim(1.0, 1.0, -2.0, 0.0)),
    ("V", dim(2.0, 1.0, -3.0, -1.0)),
    ("W", dim(2.0, 1.0, -3.0, 0.0)),
    ("Ohm", dim(2.0, 1.0, -3.0, -2.0)),
    ("H", dim(2.0, 1.0, -2.0, -2.0)),
    ("F", dim(-2.0, -1.0, 4.0, 2.0)),
];

/// Products for which custom decides, not length.
const CUSTOMARY: [(&str, Dimension); 2] =
    [("N s/m", dim(0.0, 1.0, -1.0, 0.0)), ("N s", dim(1.0, 1.0, -1.0, 0.0))];

/// Rounds away the noise of fractional exponents.
fn clean(e: f64) -> f64 {
    let rounded = (e * 720_720.0).round() / 720_720.0;
    if (rounded - e).abs() < 1e-9 { rounded } else { e }
}

/// The shortest product of at most two derived units and base units.
fn si_text(dimension: Dimension) -> String {
    let dimension = dimension.map(clean);
    if dimension.is_none() {
        return "1".into();
    }
    if let Some((text, _)) = CUSTOMARY.iter().find(|(_, d)| d.same(&dimension)) {
        return (*text).into();
    }
    let own: Vec<(&str, f64)> = dimension.declared().collect();
    let exponents = [1.0, -1.0, 0.5, -0.5, 2.0, -2.0, 1.5, -1.5, 3.0, -3.0];
    let powers: Vec<(&str, f64, Dimension)> =
        DERIVED.iter().flat_map(|(symbol, d)| exponents.map(|e| (*symbol, e, d.pow(e)))).collect();
    let mut candidates: Vec<Vec<(&str, f64, Dimension)>> = vec![Vec::new()];
    candidates.extend(powers.iter().map(|p| vec![*p]));
    for (i, first) in powers.iter().enumerate() {
        candidates.extend(powers[i + 1..].iter().filter(|p| p.0 != first.0).map(|p| vec![*first, *p]));
    }
    let mut best: Option<(f64, Vec<(&str, f64)>)> = None;
    for derived in &candidates {
        let rest = derived.iter().fold(dimension, |rest, (_, _, d)| rest / *d);
        let mut factors: Vec<(&str, f64)> = derived.iter().map(|(symbol, e, _)| (*symbol, *e)).collect();
        for (i, symbol) in BASE.iter().enumerate() {
            let e = clean(rest.si[i]);
            if e != 0.0 {
                factors.push((symbol, e));
            }
        }
        factors.extend(&own);
        // What [`Unit::parse`] would not read.
        if !derived.is_empty() && factors.iter().any(|(_, e)| e.abs() > MAX_EXPONENT) {
            continue;
        }
        // A factor costs one, each further power half, and a text without numerator a little.
        let mut cost: f64 = factors
            .iter()
            .map(|(_, e)| 1.0 + 0.5 * f64::from(u8::from(e.abs() != 1.0)) * e.abs().max(1.0))
            .sum();
        cost += if factors.iter().all(|(_, e)| *e < 0.0) { 0.1 } else { 0.0 };
        // Kinematics stay kinematics: `m/s^2`, not `N/kg`.
        cost -=
            if derived.is_empty() && dimension.si[1] == 0.0 && dimension.si[3] == 0.0 { 1.0 } else { 0.0 };
        if best.as_ref().is_none_or(|(c, _)| cost < c - 1e-9) {
            best = Some((cost, factors));
        }
    }
    let factors = best.map(|(_, factors)| factors).unwrap_or_default();
    let power =
        |(symbol, e): &(&str, f64)| if *e == 1.0 { (*symbol).to_owned() } else { format!("{symbol}^{e}") };
    // Mass before length, as in `kg m^2`; derived units come first anyway.
    let rank = |symbol: &str| if symbol == "kg" { 0 } else { 1 };
    let side = |positive: bool| {
        let mut chosen: Vec<(&str, f64)> =
            factors.iter().filter(|(_, e)| (*e > 0.0) == positive).map(|(s, e)| (*s, e.abs())).collect();
        if !chosen.iter().any(|(s, _)| DERIVED.iter().any(|(derived, _)| derived == s)) {
            chosen.sort_by_key(|(s, _)| rank(s));
        }
        chosen.iter().map(power).collect::<Vec<_>>()
    };
    let (above, below) = (side(true), side(false));
    let numerator = if above.is_empty() { "1".to_owned() } else { above.join(" ") };
    match below.len() {
        0 => numerator,
        1 => format!("{numerator}/{}", below[0]),
        _ => format!("{numerator}/({})", below.join(" ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_as_users_write_them() {
        for (text, factor, dimension) in [
            ("kg m^2", 1.0, dim(2.0, 1.0, 0.0, 0.0)),
            ("N*m/A", 1.0, dim(2.0, 1.0, -2.0, -1.0)),
            ("N\u{b7}m/A", 1.0, dim(2.0, 1.0, -2.0, -1.0)),
            ("V^0.5/s", 1.0, dim(1.0, 0.5, -2.5, -0.5)),
            ("V^(1/2)/s", 1.0, dim(1.0, 0.5, -2.5, -0.5)),
            ("N m s/rad", 1.0, dim(2.0, 1.0, -1.0, 0.0)),
            ("1", 1.0, Dimension::NONE),
            ("1/s", 1.0, dim(0.0, 0.0, -1.0, 0.0)),
            ("deg", PI / 180.0, Dimension::NONE),
            ("\u{b0}", PI / 180.0, Dimension::NONE),
            ("rpm", PI / 30.0, dim(0.0, 0.0, -1.0, 0.0)),
            ("mm", 1e-3, dim(1.0, 0.0, 0.0, 0.0)),
            ("mm^2", 1e-6, dim(2.0, 0.0, 0.0, 0.0)),
            ("m\u{b2}", 1.0, dim(2.0, 0.0, 0.0, 0.0)),
            ("s\u{207b}\u{b9}", 1.0, dim(0.0, 0.0, -1.0, 0.0)),
            ("Hz", 1.0, dim(0.0, 0.0, -1.0, 0.0)),
            ("%", 0.01, Dimension::NONE),
            ("k\u{3a9}", 1e3, dim(2.0, 1.0, -3.0, -2.0)),
            ("kOhm", 1e3, dim(2.0, 1.0, -3.0, -2.0)),
            ("\u{b5}F", 1e-6, dim(-2.0, -1.0, 4.0, 2.0)),
            ("N/m/s", 1.0, dim(0.0, 1.0, -3.0, 0.0)),
            ("N/(m s)", 1.0, dim(0.0, 1.0, -3.0, 0.0)),
            ("N/m s", 1.0, dim(0.0, 1.0, -1.0, 0.0)),
            ("km/h", 1e3 / 3600.0, dim(1.0, 0.0, -1.0, 0.0)),
            ("g", 1e-3, dim(0.0, 1.0, 0.0, 0.0)),
            ("min", 60.0, dim(0.0, 0.0, 1.0, 0.0)),
            ("mrad", 1e-3, Dimension::NONE),
            ("deg/s", PI / 180.0, dim(0.0, 0.0, -1.0, 0.0)),
            ("rev/min", PI / 30.0, dim(0.0, 0.0, -1.0, 0.0)),
            ("rps", 2.0 * PI, dim(0.0, 0.0, -1.0, 0.0)),
            ("arcmin", PI / 180.0 / 60.0, Dimension::NONE),
            ("arcsec", PI / 180.0 / 3600.0, Dimension::NONE),
            ("um", 1e-6, dim(1.0, 0.0, 0.0, 0.0)),
            ("in", 0.0254, dim(1.0, 0.0, 0.0, 0.0)),
            ("ft", 0.3048, dim(1.0, 0.0, 0.0, 0.0)),
            ("lbf", 4.448_221_615_260_5, dim(1.0, 1.0, -2.0, 0.0)),
            ("psi", 6_894.757_293_168_361, dim(-1.0, 1.0, -2.0, 0.0)),
            ("kgf", 9.80665, dim(1.0, 1.0, -2.0, 0.0)),
            ("gn", 9.80665, dim(1.0, 0.0, -2.0, 0.0)),
            ("atm", 101_325.0, dim(-1.0, 1.0, -2.0, 0.0)),
            ("mbar", 100.0, dim(-1.0, 1.0, -2.0, 0.0)),
            ("count", 1.0, Dimension::NONE),
            ("counts", 1.0, Dimension::NONE),
            ("LSB", 1.0, Dimension::NONE),
            ("px", 1.0, Dimension::NONE),
            ("count/rev", 1.0 / (2.0 * PI), Dimension::NONE),
            ("V/count", 1.0, dim(2.0, 1.0, -3.0, -1.0)),
            ("px/mm", 1e3, dim(-1.0, 0.0, 0.0, 0.0)),
            ("step/s", 1.0, dim(0.0, 0.0, -1.0, 0.0)),
            ("tick pulse", 1.0, Dimension::NONE),
            ("W/degC", 1.0, dim(2.0, 1.0, -3.0, 0.0) / Dimension::TEMPERATURE),
            ("W/(m^2 \u{b0}C)", 1.0, dim(0.0, 1.0, -3.0, 0.0) / Dimension::TEMPERATURE),
            ("degF/s", 5.0 / 9.0, Dimension::TEMPERATURE / Dimension::TIME),
        ] {
            let unit = Unit::parse(text).unwrap_or_else(|e| panic!("{text}: {e}"));
            assert!((unit.factor / factor - 1.0).abs() < 1e-14, "{text}: {}", unit.factor);
            assert!(unit.dimension.same(&dimension), "{text}: {:?}", unit.dimension);
            assert_eq!(unit.offset, 0.0, "{text}");
        }
    }

    #[test]
    fn a_temperature_alone_is_absolute_and_in_a_product_a_difference() {
        for (text, value, kelvin) in [
            ("degC", 20.0, 293.15),
            ("\u{b0}C", -273.15, 0.0),
            (" \u{2103} ", 0.0, 273.15),
            ("degF", 32.0, 273.15),
            ("\u{b0}F", 212.0, 373.15),
            ("\u{2109}", -459.67, 0.0),
            ("K", 293.15, 293.15),
            ("mK", 293_150.0, 293.15),
        ] {
            let unit = Unit::parse(text).unwrap();
            assert!((unit.to_si(value) - kelvin).abs() < 1e-12, "{text}: {}", unit.to_si(value));
            assert!((unit.from_si(kelvin) - value).abs() < 1e-9 * (1.0 + value.abs()), "{text}");
            assert!((unit.difference_to_si(value) - unit.factor * value).abs() < 1e-12);
            assert!((unit.difference_from_si(unit.difference_to_si(9.0)) - 9.0).abs() < 1e-12);
            assert_eq!(unit.dimension, Dimension::TEMPERATURE);
            assert_eq!(unit.of_difference().to_si(0.0), 0.0);
        }
        for text in ["degC^1", "1 degC", "(degC)", "degC/K", "degF degC"] {
            assert_eq!(Unit::parse(text).unwrap().offset, 0.0, "{text}");
        }
        // The sign of zero stays where there is no offset.
        assert!(Unit::parse("mm").unwrap().to_si(-0.0).is_sign_negative());
    }

    fn declared(definitions: &[(&str, &str)]) -> Units {
        let mut units = Units::default();
        for (symbol, definition) in definitions {
            units.declare(symbol, definition).unwrap_or_else(|e| panic!("{symbol} = {definition}: {e}"));
        }
        units
    }

    #[test]
    fn a_model_declares_multiples_and_dimensions() {
        let units = declared(&[
            ("enc", "2*pi/4096 rad"),
            ("slug", "14.593903 kg"),
            ("turn", "4096 enc"),
            ("dozen", "12"),
            ("room", "degC"),
            ("dose", "own"),
            ("kdose", "1e3 dose"),
            ("flux", "3 * 2 N m/(rad/s)"),
            ("alias", "N m"),
        ]);
        for (text, factor, dimension) in [
            ("enc", 2.0 * PI / 4096.0, "1"),
            ("slug", 14.593_903, "kg"),
            ("turn/s", 2.0 * PI, "1/s"),
            ("dozen", 12.0, "1"),
            ("kdose/s", 1e3, "dose/s"),
            ("dose^2/kg", 1.0, "dose^2/kg"),
            ("W/room", 1.0, "W/K"),
            ("flux", 6.0, "N m s"),
            ("1/dose", 1.0, "1/dose"),
            ("alias/dose", 1.0, "N m/dose"),
            ("kg dose", 1.0, "kg dose"),
            ("mm", 1e-3, "m"),
        ] {
            let unit = units.parse(text).unwrap_or_else(|e| panic!("{text}: {e}"));
            assert!((unit.factor / factor - 1.0).abs() < 1e-14, "{text}: {}", unit.factor);
            assert_eq!(unit.dimension.to_string(), dimension, "{text}");
            let again = units.parse(&Unit::si(unit.dimension).text).unwrap();
            assert!(again.dimension == unit.dimension && again.factor == 1.0, "{text}");
        }
        assert_eq!(units.parse("room").unwrap().to_si(20.0), 293.15);
        let [dose, kg] = ["dose", "kg"].map(|text| units.parse(text).unwrap().dimension);
        assert!(dose != kg && !dose.is_none() && (dose / dose).is_none());
        assert!((dose * kg / dose).same(&kg) && dose.pow(0.5).pow(2.0).same(&dose));
        // Without the model it is unknown, and the error says which symbol.
        assert_eq!(Unit::parse("V/dose").unwrap_err().unknown.as_deref(), Some("dose"));
        assert!(units.parse("dosse").unwrap_err().to_string().contains("did you mean `dose`"));
    }

    #[test]
    fn bad_definitions_name_the_token() {
        for (definition, place, fragment) in [
            ("", 0..0, "the unit is empty"),
            ("2 furlong", 2..9, "unknown unit `furlong`"),
            ("-2 m", 0..2, "a positive multiple"),
            ("0 m", 0..1, "a positive multiple"),
            ("1/0 m", 0..3, "a positive multiple"),
            ("1e300 Gm^2", 0..10, "overflows"),
            ("2 3 m", 2..3, "found the number `3`"),
            ("own own", 0..3, "unknown unit `own`"),
        ] {
            let error = Units::default().declare("x", definition).expect_err(definition);
            assert!(error.to_string().contains(fragment), "{definition}: {error}");
            assert_eq!(error.span, place, "{definition}: {error}");
        }
        let mut four = declared(&[("a_", "own"), ("b_", "own"), ("c_", "own"), ("d_", "own")]);
        assert!(four.declare("e_", "own").unwrap_err().to_string().contains("at most 4"));
        assert!(four.declare("e_", "2 d_").is_ok());
        let product = four.parse("a_ b_^2/(c_ e_^0.5)").unwrap();
        assert_eq!(product.dimension.declared().count(), 4);
        let long = "x".repeat(LONGEST_SYMBOL + 1);
        assert!(Units::default().declare(&long, "own").unwrap_err().to_string().contains("15 bytes"));
        for symbol in ["mm", "count", "degC", "own", "", "x2", "a b", "\u{b0}"] {
            assert!(refused_symbol(symbol).is_some(), "{symbol}");
        }
        assert!(refused_symbol("enc_a").is_none());
    }

    #[test]
    fn more_declared_dimensions_than_a_model_has_are_no_other() {
        let product = ["a", "b", "c", "d", "e"]
            .iter()
            .fold(Dimension::NONE, |product, symbol| product * Dimension::own(symbol).unwrap());
        assert!(!product.same(&product) && !product.is_none());
    }

    #[test]
    fn bad_units_name_the_token() {
        for (text, place, fragment) in [
            ("", 0..0, "write `1`"),
            ("Nm", 0..2, "write `N m` with a space"),
            ("kg m2", 3..5, "write `m^2`"),
            ("kg furlong", 3..10, "unknown unit `furlong`"),
            ("N**2", 1..3, "`^`"),
            ("N/", 2..2, "found the end"),
            ("(N m", 0..1, "never closed"),
            ("N)", 1..2, "remove it"),
            ("m^x", 2..2, "exponent"),
            ("m^1e9", 3..4, "unknown unit `e`"),
            ("100 mm", 0..3, "put it into the value"),
            ("[m]", 0..1, "without brackets"),
            ("volt", 0..4, "unknown unit `volt`"),
            ("ohms", 0..4, "did you mean `ohm`"),
            ("ticks", 0..5, "did you mean `tick`"),
            ("pixels", 0..6, "write `px`"),
            ("Celsius", 0..7, "write `degC`"),
            ("\u{ba}C", 0..3, "write `degC`"),
            ("degK", 0..4, "write `K`"),
        ] {
            let error = Unit::parse(text).expect_err(text);
            assert!(error.to_string().contains(fragment), "{text}: {error}");
            assert_eq!(error.span, place, "{text}: {error}");
        }
        assert!(Unit::parse(&"(".repeat(100_000)).is_err());
    }

    #[test]
    fn si_texts_are_readable_and_parse_back() {
        for (text, expected) in [
            ("kg m^2 s^-2", "N m"),
            ("kg m s^-2", "N"),
            ("kg m^2", "kg m^2"),
            ("kg m^2/s", "N m s"),
            ("kg/s", "N s/m"),
            ("kg/s^2", "N/m"),
            ("kg/m", "kg/m"),
            ("N/m^3", "N/m^3"),
            ("V^0.5/s", "V^0.5/s"),
            ("V^(1/3)", "V^0.3333333333333333"),
            ("1/s", "1/s"),
            ("Hz", "1/s"),
            ("s^2", "s^2"),
            ("N/V", "N/V"),
            ("V/A", "Ohm"),
            ("m/s^2", "m/s^2"),
            ("V/V", "1"),
            ("V s", "V s"),
            ("1/V^2", "1/V^2"),
            ("V/m", "V/m"),
            ("W", "W"),
            ("A", "A"),
        ] {
            let dimension = Unit::parse(text).unwrap().dimension;
            let si = Unit::si(dimension);
            let again = Unit::parse(&si.text).unwrap_or_else(|e| panic!("{}: {e}", si.text));
            assert!(again.dimension.same(&dimension) && again.factor == 1.0, "{text} -> {}", si.text);
            if text != "V^(1/3)" {
                assert_eq!(si.text, expected);
            }
        }
    }

    /// Found by the fuzzer: the shortest text of a high power had exponents that are not read.
    #[test]
    fn a_unit_that_is_read_is_written_in_si_and_read_again() {
        for symbol in ["\u{3a9}", "F", "V", "W", "H", "S"] {
            for power in (-50..=50).filter(|p| *p != 0) {
                let text = format!("{symbol}^{power}");
                let Ok(unit) = Unit::parse(&text) else { continue };
                let si = Unit::si(unit.dimension);
                let again = Unit::parse(&si.text).unwrap_or_else(|e| panic!("{text} is {si}: {e}"));
                assert!(again.dimension.same(&unit.dimension), "{text} is {si}");
            }
        }
        for text in ["mg \u{3a9}^41", "m^99 m^2", "(m^11)^10"] {
            let error = Unit::parse(text).unwrap_err();
            assert_eq!(error.span, 0..text.len());
            assert!(error.to_string().contains("power above 100"), "{error}");
        }
    }
}
