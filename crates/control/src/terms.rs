//! What a design needs changed in an equation: the time, the switches of friction, the limits of the actuator.

use greybox_model::{BinOp, Expr, Func};

/// Whether the time occurs.
pub(crate) fn timed(e: &Expr) -> bool {
    e.contains("t", 0)
}

/// The terms of a sum; a product or quotient with a sum that holds the time is multiplied out.
pub(crate) fn terms(e: &Expr) -> Vec<Expr> {
    match e {
        Expr::Neg(a) => terms(a).into_iter().map(|a| (-a).simplify()).collect(),
        Expr::Bin(BinOp::Add, a, b) => [terms(a), terms(b)].concat(),
        Expr::Bin(BinOp::Sub, a, b) => {
            terms(a).into_iter().chain(terms(b).into_iter().map(|b| (-b).simplify())).collect()
        }
        Expr::Bin(BinOp::Mul, a, b) if timed(a) || timed(b) => {
            let (left, right) = (factor(a), factor(b));
            let all = left.iter().flat_map(|a| right.iter().map(move |b| (a.clone() * b.clone()).simplify()));
            all.collect()
        }
        Expr::Bin(BinOp::Div, a, b) if timed(a) => {
            terms(a).into_iter().map(|a| (a / (**b).clone()).simplify()).collect()
        }
        e => vec![e.clone()],
    }
}

fn factor(e: &Expr) -> Vec<Expr> {
    if timed(e) { terms(e) } else { vec![e.clone()] }
}

/// `sign(v)` by what `by` makes of v, wherever v moves.
pub(crate) fn without_signs(e: &Expr, moves: &dyn Fn(&Expr) -> bool, by: &dyn Fn(&Expr) -> Expr) -> Expr {
    e.map(&mut |e| match &e {
        Expr::Call(Func::Sign, args) if args.first().is_some_and(moves) => by(&args[0]),
        _ => e,
    })
}

/// `deadzone(d, gap)` by d wherever d moves; what was replaced goes to `closed`.
pub(crate) fn without_gaps(e: &Expr, moves: &dyn Fn(&Expr) -> bool, closed: &mut Vec<Expr>) -> Expr {
    e.map(&mut |e| match &e {
        Expr::Call(Func::Deadzone, args) if args.first().is_some_and(moves) => {
            let inner = args[0].clone();
            closed.push(e);
            inner
        }
        _ => e,
    })
}

/// `delay(u, tau)` of the input by the input; how late it is goes to `late`, one entry for each place: tau and its value.
pub(crate) fn without_input_delay(
    e: &Expr,
    input: &str,
    value: &dyn Fn(&Expr) -> Option<f64>,
    late: &mut Vec<(Expr, f64)>,
) -> Expr {
    e.map(&mut |e| {
        let Expr::Call(Func::Delay, args) = &e else { return e };
        let (Expr::Var { name, primes: 0 }, Some(tau)) = (&args[0], value(&args[1])) else { return e };
        if **name != *input || tau.is_nan() || tau < 0.0 {
            return e;
        }
        late.push((args[1].clone(), tau));
        args[0].clone()
    })
}

/// What an actuator makes of the input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Range {
    /// Lower and upper limit.
    pub(crate) limits: (f64, f64),
    /// Half width of the dead zone.
    pub(crate) dead_zone: Option<f64>,
}

impl Default for Range {
    fn default() -> Self {
        Self { limits: (f64::NEG_INFINITY, f64::INFINITY), dead_zone: None }
    }
}

/// Takes `saturate`, `min`, `max` and `deadzone` off the input: what they leave of it is its range. One whose bounds
/// are not constant stays, and so does a dead zone that is not around zero, or not the same everywhere.
pub(crate) fn without_limits(
    e: &Expr,
    input: &str,
    value: &dyn Fn(&Expr) -> Option<f64>,
    range: &mut Range,
) -> Expr {
    e.map(&mut |e| {
        let Expr::Call(f @ (Func::Saturate | Func::Min | Func::Max | Func::Deadzone), args) = &e else {
            return e;
        };
        let [a, b] = args.as_slice() else { return e };
        let (inner, bound) = match (a.mentions(input), b.mentions(input)) {
            (true, false) => (a, b),
            (false, true) if matches!(f, Func::Min | Func::Max) => (b, a),
            _ => return e,
        };
        let Some((slope, rest)) = inner.affine_in(&[(input, 0)]) else { return e };
        let (Some(slope), Some(rest), Some(bound)) = (value(&slope[0]), value(&rest), value(bound)) else {
            return e;
        };
        if !(slope != 0.0 && slope.is_finite() && rest.is_finite() && bound.is_finite()) {
            return e;
        }
        if *f == Func::Deadzone {
            let gap = bound / slope.abs();
            let same = range.dead_zone.is_none_or(|g| (g - gap).abs() <= 1e-12 * gap);
            if rest != 0.0 || gap < 0.0 || !same {
                return e;
            }
            range.dead_zone = Some(gap);
            return inner.clone();
        }
        let at = |bound: f64| (bound - rest) / slope;
        let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
        match f {
            Func::Saturate => (low, high) = (at(-bound).min(at(bound)), at(-bound).max(at(bound))),
            Func::Min if slope > 0.0 => high = at(bound),
            Func::Min => low = at(bound),
            _ if slope > 0.0 => low = at(bound),
            _ => high = at(bound),
        }
        // Behind a dead zone: the input may be larger by what that swallows.
        let gap = range.dead_zone.unwrap_or(0.0);
        range.limits = (range.limits.0.max(low - gap), range.limits.1.min(high + gap));
        inner.clone()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_model::parse;

    fn expr(text: &str) -> Expr {
        parse(text).unwrap().expr
    }

    #[test]
    fn terms_with_the_time_are_multiplied_out() {
        let found: Vec<String> = terms(&expr("k*(u + a*sin(t)) - (b + c*t)/m - k*(x - y)"))
            .iter()
            .map(|e| e.to_string())
            .collect();
        assert_eq!(found, ["k*u", "k*a*sin(t)", "-b/m", "-c*t/m", "-k*(x - y)"]);
    }

    #[test]
    fn limits_are_told_in_the_input() {
        let value = |e: &Expr| e.eval(&|name, _| (name == "lim").then_some(6.0));
        let mut range = Range::default();
        let free = without_limits(&expr("k*saturate(2*u - 1, lim)"), "u", &value, &mut range);
        assert_eq!((free, range.limits), (expr("k*(2*u - 1)"), (-2.5, 3.5)));
        let free = without_limits(&expr("min(max(-u, -3), 2)"), "u", &value, &mut range);
        assert_eq!((free, range.limits), (expr("-u"), (-2.0, 3.0)));
        let free = without_limits(&expr("deadzone(-2*u, lim/12)"), "u", &value, &mut range);
        assert_eq!((free, range.dead_zone), (expr("-2*u"), Some(0.25)));
        for stays in ["saturate(u, x)", "deadzone(u, 0.3)", "deadzone(u - 1, 0.25)"] {
            assert_eq!(without_limits(&expr(stays), "u", &value, &mut range), expr(stays));
        }
    }
}
