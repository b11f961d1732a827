//! Functions given by their values at knots.

use crate::expr::{Expr, Func};

/// Most knots of a table: its derivative is a sum over them, which has to stay a tree of moderate depth.
pub const MAX_KNOTS: usize = 200;

/// The parts of `table(x, [k1, …, kn], [v1, …, vn])`: linear between the knots, and held beyond the first and the last,
///
/// ```text
/// f(x) = v₁ + s₁ (x̄ − k₁) + Σ_{i=2…n−1} (sᵢ − sᵢ₋₁) max(x̄ − kᵢ, 0)
/// sᵢ = (vᵢ₊₁ − vᵢ)/(kᵢ₊₁ − kᵢ),    x̄ = min(max(x, k₁), kₙ)
/// ```
///
/// It is linear in the values. The knots are numbers, so x has no dimension; the values share one.
///
/// ```
/// use greybox_model::parse;
///
/// let spring = parse("table(x/x0, [-1, 0, 2], [fa, 0, fb])")?.expr;
/// let value = |x: f64| {
///     let of = |name: &str, _: u8| [("x", x), ("x0", 0.1), ("fa", -5.0), ("fb", 8.0)].iter().find(|v| v.0 == name).map(|v| v.1);
///     spring.eval(&of)
/// };
/// assert_eq!(value(0.1), Some(4.0));
/// assert_eq!(value(-0.7), Some(-5.0));
/// # Ok::<(), greybox_model::SyntaxError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Table<'a> {
    /// The argument.
    pub x: &'a Expr,
    /// Increasing; two at least.
    pub knots: Vec<f64>,
    /// As many.
    pub values: &'a [Expr],
}

impl<'a> Table<'a> {
    /// Reads the arguments of a call; `None` where they are not those of a table.
    pub fn of(args: &'a [Expr]) -> Option<Table<'a>> {
        let (x, rest) = args.split_first()?;
        let n = rest.len() / 2;
        if rest.len() != 2 * n || !(2..=MAX_KNOTS).contains(&n) {
            return None;
        }
        let (knots, values) = rest.split_at(n);
        let number = |e: &Expr| if let Expr::Num(v) = e { Some(*v) } else { None };
        let knots: Vec<f64> = knots.iter().map(number).collect::<Option<_>>()?;
        let increase = knots.windows(2).all(|k| k[0] < k[1]) && (knots[n - 1] - knots[0]).is_finite();
        increase.then_some(Table { x, knots, values })
    }

    /// The call of a table.
    pub fn call(x: Expr, knots: &[f64], values: Vec<Expr>) -> Expr {
        let args = std::iter::once(x).chain(knots.iter().map(|k| Expr::Num(*k))).chain(values);
        Expr::Call(Func::Table, args.collect())
    }
}

impl Func {
    /// Whether these may be its arguments: as many as it takes, and knots that are increasing numbers.
    pub fn takes(self, args: &[Expr]) -> bool {
        match self.arity() {
            Some(arity) => args.len() == arity,
            None => Table::of(args).is_some(),
        }
    }
}

/// The value at `x` of a table with these knots and as many values; not a number where `x` is none.
pub(crate) fn interpolate(knots: &[f64], values: &[f64], x: f64) -> f64 {
    let last = knots.len() - 1;
    if x.is_nan() || x <= knots[0] {
        return if x.is_nan() { x } else { values[0] };
    }
    if x >= knots[last] {
        return values[last];
    }
    let i = knots.partition_point(|k| *k <= x) - 1;
    values[i] + (values[i + 1] - values[i]) / (knots[i + 1] - knots[i]) * (x - knots[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_between_knots_and_held_beyond_them() {
        let (k, v) = ([-1.0, 0.0, 2.0], [3.0, 1.0, 5.0]);
        let at = |x| interpolate(&k, &v, x);
        for (x, y) in [(-9.0, 3.0), (-1.0, 3.0), (-0.25, 1.5), (0.0, 1.0), (0.5, 2.0), (2.0, 5.0), (7.0, 5.0)]
        {
            assert_eq!(at(x), y, "{x}");
        }
        assert!(at(f64::NAN).is_nan());
    }

    #[test]
    fn what_is_no_table_is_refused() {
        let of = |knots: &[f64], n: usize| {
            let call = Table::call(Expr::var("x"), knots, vec![Expr::var("v"); n]);
            let Expr::Call(_, args) = &call else { return false };
            Table::of(args).is_some()
        };
        assert!(of(&[0.0, 1.0], 2) && of(&[-2.0, 0.5, 1.0], 3));
        for (knots, n) in [
            (&[0.0][..], 1),
            (&[0.0, 1.0], 3),
            (&[1.0, 0.0], 2),
            (&[0.0, 0.0], 2),
            (&[0.0, f64::NAN], 2),
            (&[], 0),
        ] {
            assert!(!of(knots, n), "{knots:?}, {n}");
        }
    }
}
