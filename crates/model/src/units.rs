//! Run-time units: a dimension (exponents of the SI base units), a factor to SI and the text as the
//! user wrote it. Radians count as dimensionless, as textbooks mix `N m` and `N m/rad` freely.
//!
//! ```text
//! unit   = factor {["*" | "·" | "/"] factor}      a space multiplies; "/" divides by the next factor only
//! factor = (symbol | "1" | "(" unit ")") ["^" exponent]
//! ```

use crate::nearest::nearest;
use std::f64::consts::PI;
use std::fmt;
use std::ops::{Div, Mul, Range};

/// Exponents of m, kg, s, A, K, mol, cd.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Dimension(pub [f64; 7]);

/// A unit as written, with its meaning.
#[derive(Debug, Clone, PartialEq)]
pub struct Unit {
    /// As the user wrote it, e.g. `N m/V`.
    pub text: String,
    /// SI value of one of this unit (`mm` → 1e-3, `deg` → π/180).
    pub factor: f64,
    /// Its dimension.
    pub dimension: Dimension,
}

/// Text that is not a unit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}{}", .help.as_ref().map(|h| format!("; mend: {h}")).unwrap_or_default())]
pub struct UnitError {
    /// The offending token, in bytes of the unit's text.
    pub span: Range<usize>,
    /// What is wrong.
    pub message: String,
    /// How to mend it.
    pub help: Option<String>,
}

const fn dim(m: f64, kg: f64, s: f64, a: f64) -> Dimension {
    Dimension([m, kg, s, a, 0.0, 0.0, 0.0])
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
    ("K", 1.0, Dimension([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), true),
    ("mol", 1.0, Dimension([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]), true),
    ("cd", 1.0, Dimension([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), true),
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
    /// No dimension.
    pub const NONE: Dimension = Dimension([0.0; 7]);
    /// Time.
    pub const TIME: Dimension = dim(0.0, 0.0, 1.0, 0.0);

    /// Whether both are equal up to rounding of fractional exponents (1e-9).
    pub fn same(&self, other: &Dimension) -> bool {
        self.0.iter().zip(other.0).all(|(a, b)| (a - b).abs() < 1e-9)
    }

    /// Whether it is [`Dimension::NONE`] up to rounding.
    pub fn is_none(&self) -> bool {
        self.same(&Dimension::NONE)
    }

    /// Every exponent times `exponent`.
    pub fn pow(self, exponent: f64) -> Dimension {
        Dimension(self.0.map(|e| e * exponent))
    }
}

impl Mul for Dimension {
    type Output = Dimension;
    fn mul(self, other: Dimension) -> Dimension {
        Dimension(std::array::from_fn(|i| self.0[i] + other.0[i]))
    }
}

impl Div for Dimension {
    type Output = Dimension;
    fn div(self, other: Dimension) -> Dimension {
        Dimension(std::array::from_fn(|i| self.0[i] - other.0[i]))
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
        Unit { text: "1".into(), factor: 1.0, dimension: Dimension::NONE }
    }

    /// The SI unit of a dimension, written readably: mechanical and electrical derived units where
    /// they make it shorter (`N m`, `N s/m`, `V^0.5/s`), base units else (`kg m^2`). Its text parses
    /// back to the same dimension with factor 1.
    pub fn si(dimension: Dimension) -> Unit {
        Unit { text: si_text(dimension), factor: 1.0, dimension }
    }

    /// Parses a unit as engineers write it.
    ///
    /// `/` divides by the next factor only: `N/m s` is (N/m)·s, and `N/(m s)` or `N/m/s` divides by
    /// both. `rad`, `sr` and `1` are dimensionless with factor 1, `%` is 0.01, `deg` π/180, `rpm`
    /// π/30 s⁻¹, `Hz` 1 s⁻¹. Superscript digits are accepted.
    ///
    /// ```
    /// use greybox_model::Unit;
    /// let kt = Unit::parse("N*m/A")?;
    /// assert_eq!(kt.dimension, Unit::parse("V s")?.dimension);
    /// assert_eq!(Unit::parse("mm")?.factor, 1e-3);
    /// # Ok::<(), greybox_model::UnitError>(())
    /// ```
    ///
    /// # Errors
    /// [`UnitError`] names the offending token and its mend.
    pub fn parse(text: &str) -> Result<Unit, UnitError> {
        let mut parser = UnitParser { text, position: 0 };
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
        if !(factor.is_finite() && factor > 0.0) {
            return Err(unit_error(
                0..text.len(),
                "the unit's factor to SI overflows",
                Some("use a smaller exponent"),
            ));
        }
        // Within it, the unit can be written in SI and read again.
        if dimension.0.iter().any(|e| e.abs() > MAX_EXPONENT) {
            return Err(unit_error(
                0..text.len(),
                format!("a base unit stands to a power above {MAX_EXPONENT} in it"),
                Some("use a smaller exponent"),
            ));
        }
        Ok(Unit { text: text.trim().to_owned(), factor, dimension })
    }
}

fn unit_error(span: Range<usize>, message: impl Into<String>, help: Option<&str>) -> UnitError {
    UnitError { span, message: message.into(), help: help.map(str::to_owned) }
}

struct UnitParser<'a> {
    text: &'a str,
    position: usize,
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
        let is_letter = |c: char| c.is_alphabetic() || matches!(c, '%' | '\u{b0}' | '_');
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
        let Some(found) = lookup(symbol) else {
            return Err(UnitError {
                span,
                message: format!("unknown unit `{symbol}`"),
                help: Some(suggestion(symbol)),
            });
        };
        // `m2` is a slip for `m^2`; superscripts are taken by `exponent`.
        let digits = self.take(|c| c.is_ascii_digit());
        if !digits.is_empty() {
            let wrong = &self.text[span.start..digits.end];
            let mend = format!("write `{symbol}^{}`", &self.text[digits.clone()]);
            return Err(unit_error(span.start..digits.end, format!("unknown unit `{wrong}`"), Some(&mend)));
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

/// What may have been meant by an unknown symbol.
fn suggestion(symbol: &str) -> String {
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
    match nearest(symbol, SYMBOLS.iter().map(|s| s.0).chain(common)) {
        Some(near) => format!("did you mean `{near}`?"),
        None => "use SI units with prefixes (`m kg s A K N J W Pa V Ohm F H T Wb C S Hz`), `rad`, `deg`, `rpm`, `%` or `1`".into(),
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
    let dimension = Dimension(dimension.0.map(clean));
    if dimension.is_none() {
        return "1".into();
    }
    if let Some((text, _)) = CUSTOMARY.iter().find(|(_, d)| d.same(&dimension)) {
        return (*text).into();
    }
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
            let e = clean(rest.0[i]);
            if e != 0.0 {
                factors.push((symbol, e));
            }
        }
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
        cost -= if derived.is_empty() && dimension.0[1] == 0.0 && dimension.0[3] == 0.0 { 1.0 } else { 0.0 };
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
        if chosen.iter().all(|(s, _)| BASE.contains(s)) {
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
        ] {
            let unit = Unit::parse(text).unwrap_or_else(|e| panic!("{text}: {e}"));
            assert!((unit.factor / factor - 1.0).abs() < 1e-14, "{text}: {}", unit.factor);
            assert!(unit.dimension.same(&dimension), "{text}: {:?}", unit.dimension);
        }
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
