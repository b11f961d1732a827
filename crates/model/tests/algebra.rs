//! Properties of parsing, printing and symbolic algebra over random expressions.

use greybox_model::{BinOp, Expr, Func, Table, parse, parse_equation};
use proptest::prelude::*;

/// Any tree of the language with finite numbers and no sign directly over a number.
fn any_expr() -> impl Strategy<Value = Expr> {
    let leaf = prop_oneof![
        prop_oneof![Just(0.0), Just(1.0), Just(2.0), Just(5.3e-6), -1e3..1e3, -1e20..1e20f64]
            .prop_map(Expr::Num),
        (prop::sample::select(vec!["x", "theta", "k_1"]), 0u8..3).prop_map(|(n, p)| Expr::prime(n, p)),
    ];
    leaf.prop_recursive(6, 40, 2, |inner| {
        let op = prop::sample::select(vec![BinOp::Add, BinOp::Sub, BinOp::Mul, BinOp::Div, BinOp::Pow]);
        let fixed: Vec<Func> = Func::ALL.into_iter().filter(|f| f.arity().is_some()).collect();
        let function = prop::sample::select(fixed);
        prop_oneof![
            inner.clone().prop_map(|a| match a {
                Expr::Num(v) => Expr::Num(-v),
                a => -a,
            }),
            (op, inner.clone(), inner.clone()).prop_map(|(op, a, b)| Expr::Bin(op, Box::new(a), Box::new(b))),
            (function, inner.clone(), inner.clone())
                .prop_map(|(f, a, b)| Expr::call(f, if f.arity() == Some(1) { vec![a] } else { vec![a, b] })),
            (-5.0..5.0f64, 1e-3..1e3f64, inner.clone(), inner.clone(), inner)
                .prop_map(|(k, step, x, v, w)| Table::call(x, &[k, k + step], vec![v, w])),
        ]
    })
}

/// Of the tables in the trees below.
const KNOTS: [f64; 4] = [-1.5, -0.2, 0.9, 1.1];

/// Trees whose value stays moderate, so that finite differences mean something.
fn smooth_expr() -> impl Strategy<Value = Expr> {
    let leaf = prop_oneof![
        (-3.0..3.0f64).prop_map(Expr::Num),
        Just(Expr::var("x")),
        Just(Expr::var("x")),
        Just(Expr::prime("x", 1)),
    ];
    leaf.prop_recursive(4, 16, 2, |inner| {
        let pair = (inner.clone(), inner.clone());
        prop_oneof![
            inner.clone().prop_map(|a| -a),
            pair.clone().prop_map(|(a, b)| a + b),
            pair.clone().prop_map(|(a, b)| a - b),
            pair.clone().prop_map(|(a, b)| a * b),
            pair.clone().prop_map(|(a, b)| a / (Expr::Num(2.0) + b.clone() * b)),
            (inner.clone(), prop::sample::select(vec![2.0, 3.0])).prop_map(|(a, n)| a.pow(Expr::Num(n))),
            pair.clone().prop_map(|(a, b)| {
                (Expr::Num(1.5) + Expr::call(Func::Tanh, vec![a])).pow(Expr::call(Func::Sin, vec![b]))
            }),
            (
                prop::sample::select(vec![
                    Func::Sin,
                    Func::Cos,
                    Func::Tanh,
                    Func::Atan,
                    Func::Abs,
                    Func::Sign
                ]),
                inner.clone()
            )
                .prop_map(|(f, a)| Expr::call(f, vec![a])),
            inner.clone().prop_map(|a| Expr::call(Func::Exp, vec![Expr::call(Func::Sin, vec![a])])),
            inner.clone().prop_map(|a| {
                let positive = Expr::Num(0.5) + a.clone() * a;
                Expr::call(Func::Ln, vec![positive.clone()]) + Expr::call(Func::Sqrt, vec![positive])
            }),
            (prop::sample::select(vec![Func::Min, Func::Max, Func::Delay]), inner.clone(), inner.clone())
                .prop_map(|(f, a, b)| Expr::call(f, vec![a, b])),
            (inner.clone(), inner.clone(), -3.0..3.0f64).prop_map(|(x, v, w)| {
                Table::call(x, &KNOTS, vec![v.clone(), Expr::Num(w), v, Expr::Num(1.0)])
            }),
            (prop::sample::select(vec![Func::Deadzone, Func::Saturate]), inner.clone(), inner).prop_map(
                |(f, a, b)| {
                    let width = Expr::Num(0.3) + Expr::call(Func::Abs, vec![Expr::call(Func::Sin, vec![b])]);
                    Expr::call(f, vec![a, width])
                }
            ),
        ]
    })
}

fn at(e: &Expr, x: f64, v: f64) -> f64 {
    let value = |name: &str, primes: u8| match (name, primes) {
        ("x", 0) => Some(x),
        ("x", 1) => Some(v),
        _ => None,
    };
    e.eval(&value).expect("only x and x' occur")
}

/// A value and its slope, by rules of its own; `near` keeps the smallest distance to a kink or a jump.
fn dual(e: &Expr, of: &dyn Fn(&str, u8) -> (f64, f64), near: &mut f64) -> (f64, f64) {
    match e {
        Expr::Num(v) => (*v, 0.0),
        Expr::Var { name, primes } => of(name, *primes),
        Expr::Neg(a) => {
            let (a, da) = dual(a, of, near);
            (-a, -da)
        }
        Expr::Bin(op, a, b) => {
            let ((a, da), (b, db)) = (dual(a, of, near), dual(b, of, near));
            match op {
                BinOp::Add => (a + b, da + db),
                BinOp::Sub => (a - b, da - db),
                BinOp::Mul => (a * b, da * b + a * db),
                BinOp::Div => (a / b, (da * b - a * db) / (b * b)),
                BinOp::Pow if db == 0.0 => (a.powf(b), b * a.powf(b - 1.0) * da),
                BinOp::Pow => (a.powf(b), a.powf(b) * (db * a.ln() + b * da / a)),
            }
        }
        Expr::Call(Func::Table, args) => {
            let (x, dx) = dual(&args[0], of, near);
            let v: Vec<(f64, f64)> = args[5..].iter().map(|v| dual(v, of, near)).collect();
            KNOTS.iter().for_each(|k| *near = near.min((x - k).abs()));
            let Some(i) = KNOTS.windows(2).position(|k| (k[0]..k[1]).contains(&x)) else {
                return if x < KNOTS[0] { v[0] } else { v[3] };
            };
            let width = KNOTS[i + 1] - KNOTS[i];
            let w = (x - KNOTS[i]) / width;
            let slope = (v[i + 1].0 - v[i].0) / width * dx + (1.0 - w) * v[i].1 + w * v[i + 1].1;
            ((1.0 - w) * v[i].0 + w * v[i + 1].0, slope)
        }
        Expr::Call(f, args) => {
            let (a, da) = dual(&args[0], of, near);
            let (b, db) = args.get(1).map_or((0.0, 0.0), |b| dual(b, of, near));
            let mut kink = |at: f64| *near = near.min(at.abs());
            match f {
                Func::Sin => (a.sin(), a.cos() * da),
                Func::Cos => (a.cos(), -a.sin() * da),
                Func::Tan => (a.tan(), da / a.cos().powi(2)),
                Func::Exp => (a.exp(), a.exp() * da),
                Func::Ln => (a.ln(), da / a),
                Func::Sqrt => (a.sqrt(), da / (2.0 * a.sqrt())),
                Func::Tanh => (a.tanh(), da / a.cosh().powi(2)),
                Func::Atan => (a.atan(), da / (1.0 + a * a)),
                Func::Delay => (a, da),
                Func::Abs | Func::Sign => {
                    kink(a);
                    if *f == Func::Abs { (a.abs(), a.signum() * da) } else { (a.signum(), 0.0) }
                }
                Func::Min | Func::Max => {
                    kink(a - b);
                    if (a < b) == (*f == Func::Min) { (a, da) } else { (b, db) }
                }
                Func::Deadzone | Func::Saturate => {
                    kink(a.abs() - b);
                    let (beyond, slope) = (a - a.signum() * b, da - a.signum() * db);
                    match (a.abs() > b, *f == Func::Deadzone) {
                        (true, true) => (beyond, slope),
                        (true, false) => (a - beyond, da - slope),
                        (false, true) => (0.0, 0.0),
                        (false, false) => (a, da),
                    }
                }
                Func::Step => {
                    kink(a - b);
                    (f64::from(u8::from(a >= b)), 0.0)
                }
                Func::Table => unreachable!("handled above"),
            }
        }
    }
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-9 * (1.0 + a.abs().max(b.abs()))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1500))]

    #[test]
    fn printing_then_parsing_keeps_the_tree(e in any_expr()) {
        let text = e.to_string();
        let again = parse(&text).map_err(|e| TestCaseError::fail(format!("{text}: {e}")))?;
        prop_assert_eq!(&again.expr, &e, "{}", text);
        let mut nodes = 0;
        e.walk(&mut |_| nodes += 1);
        prop_assert_eq!(again.spans.len(), nodes);
        let simple = e.simplify();
        prop_assert_eq!(parse(&simple.to_string()).map(|p| p.expr), Ok(simple.clone()), "{}", simple);
    }

    #[test]
    fn simplify_keeps_the_value(e in smooth_expr(), x in -2.0..2.0f64, v in -2.0..2.0f64) {
        let (before, after) = (at(&e, x, v), at(&e.simplify(), x, v));
        if before.is_finite() && before.abs() < 1e6 {
            // `sign` of a rounding error is the one thing that may differ: skip points beside kinks.
            let near = at(&e, x + 1e-7, v + 1e-7);
            prop_assume!((near - before).abs() < 1e-2 * (1.0 + before.abs()));
            prop_assert!((before - after).abs() <= 1e-6 * (1.0 + before.abs()), "{e} -> {}: {before} {after}", e.simplify());
        }
    }

    #[test]
    fn derivative_agrees_with_differences(e in smooth_expr(), x in -2.0..2.0f64, v in -2.0..2.0f64) {
        let h = 1e-5;
        let (minus, here, plus) = (at(&e, x - h, v), at(&e, x, v), at(&e, x + h, v));
        let (left, right) = ((here - minus) / h, (plus - here) / h);
        let scale = 1.0 + here.abs() + left.abs();
        // Away from kinks and jumps, and where the curvature leaves differences meaningful.
        prop_assume!(scale < 1e4 && (left - right).abs() < 1e-3 * scale);
        let exact = at(&e.derivative("x", 0), x, v);
        prop_assert!((exact - (left + right) / 2.0).abs() < 2e-3 * scale, "d/dx {e} = {}: {exact}, {left}", e.derivative("x", 0));
    }

    #[test]
    fn derivative_agrees_with_dual_numbers(e in smooth_expr(), x in -2.0..2.0f64, v in -2.0..2.0f64) {
        for (primes, name) in [(0u8, "x"), (1, "x'")] {
            let of = |_: &str, p: u8| if p == 0 { (x, f64::from(1 - primes)) } else { (v, f64::from(primes)) };
            let mut near = f64::INFINITY;
            let (value, slope) = dual(&e, &of, &mut near);
            prop_assume!(near > 1e-9 && slope.is_finite() && slope.abs() < 1e9 && value.abs() < 1e9);
            let exact = e.derivative("x", primes);
            let found = at(&exact, x, v);
            prop_assert!((found - slope).abs() <= 1e-7 * (1.0 + value.abs() + slope.abs()), "d/d{name} {e} = {exact}: {found} {slope}");
        }
    }

    #[test]
    fn time_derivative_is_the_chain_rule(e in smooth_expr(), x in -2.0..2.0f64, v in -2.0..2.0f64, a in -2.0..2.0f64) {
        let value = |name: &str, p: u8| (name == "x").then(|| [x, v, a][usize::from(p)]);
        let total = e.time_derivative(&|n| n == "x").eval(&value).expect("x, x', x''");
        let chain = at(&e.derivative("x", 0), x, v) * v + at(&e.derivative("x", 1), x, v) * a;
        prop_assert!(!total.is_finite() || close(total, chain), "{e}: {total} {chain}");
    }

    #[test]
    fn affine_parts_add_up(a in smooth_expr(), b in smooth_expr(), x in -2.0..2.0f64, v in -2.0..2.0f64, q in -2.0..2.0f64) {
        let e = a.clone() * Expr::prime("q", 2) - (b.clone() - Expr::prime("q", 2)) / Expr::Num(2.0);
        let (coefficients, rest) = e.affine_in(&[("q", 2)]).expect("affine by construction");
        let value = |name: &str, p: u8| match (name, p) { ("x", 0) => Some(x), ("x", 1) => Some(v), _ => Some(q) };
        let whole = e.eval(&value).expect("all known");
        let sum = coefficients[0].eval(&value).expect("known") * q + rest.eval(&value).expect("known");
        prop_assume!(whole.abs() < 1e9);
        prop_assert!((whole - sum).abs() <= 1e-6 * (1.0 + whole.abs()), "{e}: {} and {rest}", coefficients[0]);
    }

    #[test]
    fn no_text_makes_the_parser_panic(text in "[-+*/^()=,.'a-c0-9e θ−²]{0,40}") {
        if let Err(e) = parse(&text) {
            prop_assert!(e.span.end <= text.len() && text.get(e.span.clone()).is_some());
        }
        let _ = parse_equation(&text);
    }
}

#[test]
fn precedence_is_that_of_textbooks() {
    let values = |name: &str, _: u8| match name {
        "x" => Some(3.0),
        "y" => Some(2.0),
        _ => None,
    };
    for (text, expected) in [
        ("-x^2", -9.0),
        ("(-x)^2", 9.0),
        ("x^-y", 1.0 / 9.0),
        ("2^x^y", 512.0),
        ("x/y/y", 0.75),
        ("x/-y*x", -4.5),
        ("-x/y*x", -4.5),
        ("x - y - 1", 0.0),
        ("x - -y", 5.0),
        ("x - (y - 1)", 2.0),
        ("+x", 3.0),
        ("1e-3*x", 0.003),
        ("2.5E+1", 25.0),
        (".5*x", 1.5),
        ("-2^2", -4.0),
        ("pi", std::f64::consts::PI),
        ("min(x, y) + max(x, y)", 5.0),
        ("deadzone(x, 1) + deadzone(-x, 2) + deadzone(x, 4)", 1.0),
        ("saturate(-x, y)", -2.0),
        ("step(x, y) + step(y, x) + step(x, x)", 2.0),
        ("sign(x) + sign(-y) + sign(0)", 0.0),
        ("delay(x, y)", 3.0),
    ] {
        let e = parse(text).unwrap_or_else(|e| panic!("{text}: {e}")).expr;
        assert_eq!(e.eval(&values), Some(expected), "{text} = {e}");
    }
}

#[test]
fn simplify_reads_like_physics() {
    for (text, expected) in [
        ("0*x + 1*y", "y"),
        ("x + -y*z", "x - y*z"),
        ("a - (-b)", "a + b"),
        ("a*(-b)", "-a*b"),
        ("(-2)*x", "-2*x"),
        ("a + (b + c)", "a + b + c"),
        ("a*(b*c)", "a*b*c"),
        ("x^1 + y^0", "x + 1"),
        ("2*3*x", "6*x"),
        ("sign(0)*x", "sign(0)*x"),
        ("1/0", "1/0"),
        ("delay(3, tau)", "3"),
        ("x - x", "0"),
        ("0 - x", "-x"),
    ] {
        assert_eq!(parse(text).unwrap().expr.simplify().to_string(), expected, "{text}");
    }
}

#[test]
fn not_affine_is_said() {
    for text in ["sin(q'')", "q''^2", "1/q''", "q''*q''", "delay(q'', 1)", "x^q''"] {
        assert_eq!(parse(text).unwrap().expr.affine_in(&[("q", 2)]), None, "{text}");
    }
    let (c, r) = parse("m*(q'' + p'') + k*q - u").unwrap().expr.affine_in(&[("q", 2), ("p", 2)]).unwrap();
    assert_eq!(
        (c[0].to_string(), c[1].to_string(), r.to_string()),
        ("m".into(), "m".into(), "k*q - u".into())
    );
}

#[test]
fn deep_input_is_an_error_not_a_crash() {
    for text in [
        format!("{}x{}", "(".repeat(100_000), ")".repeat(100_000)),
        "(".repeat(100_000),
        "-".repeat(100_000),
        "sin(".repeat(100_000),
        format!("{}1", "2^".repeat(100_000)),
        format!("{}1", "x + ".repeat(100_000)),
        format!("x{}", "'".repeat(100_000)),
    ] {
        let error = parse(&text).unwrap_err();
        assert!(error.message.len() < 300, "{}", error.message);
    }
    // What people write passes.
    parse(&format!("{}1", "x*y + ".repeat(300))).unwrap();
    parse(&format!("{}x{}", "(".repeat(60), ")".repeat(60))).unwrap();
}

/// What is printed has parentheses that the text did without, and is read again all the same.
#[test]
fn what_is_read_can_be_printed_and_read_again() {
    let signs = |n: usize| format!("{}x", "-".repeat(n));
    let powers = |n: usize| format!("{}x", "2^-".repeat(n));
    let factors = |n: usize| format!("{}x", "a*-sin(".repeat(n)) + &")".repeat(n);
    for text in [&signs as &dyn Fn(usize) -> String, &powers, &factors] {
        let mut longest = 0;
        for n in 1..200 {
            match parse(&text(n)) {
                Ok(parsed) => {
                    let printed = parsed.expr.to_string();
                    let again = parse(&printed).unwrap_or_else(|e| panic!("{printed}: {}", e.message));
                    assert_eq!(again.expr, parsed.expr);
                    longest = n;
                }
                Err(error) => assert!(error.message.contains("nested deeper"), "{}", error.message),
            }
        }
        // Far beyond what people write.
        assert!((20..100).contains(&longest), "{} {longest}", text(3));
    }
}

/// text → place of the error, then fragments of its message.
#[test]
fn syntax_errors_name_the_help() {
    for (text, place, fragments) in [
        ("2theta", 1..6, &["`theta` after `2`", "write `2*theta`"] as &[_]),
        ("2 x", 2..3, &["write `2*x`"]),
        ("a b", 2..3, &["found `b` after `a`", "write `a*b`"]),
        ("(a + b)(c)", 7..8, &["write `)*(`"]),
        ("theta ''", 6..8, &["apart from its name", "write `theta''` without the space"]),
        ("(x + y)'", 7..8, &["after `)`", "only names have primes"]),
        ("''x", 0..2, &["found `''`"]),
        ("x**2", 1..3, &["found `**`", "`^`"]),
        ("x \u{2212} y", 2..5, &["minus sign `-`"]),
        ("x\u{b2}", 1..3, &["write `^2`"]),
        ("x\u{2032}", 1..4, &["write the prime as `'`"]),
        ("k\u{b7}x", 1..3, &["write `*`"]),
        ("x = 0", 2..3, &["found `=`"]),
        ("sine(x)", 0..4, &["unknown function `sine`", "did you mean `sin`", "`sine*(`"]),
        ("foo(x)", 0..3, &["unknown function `foo`", "`foo*(`", "tanh"]),
        ("sin x", 0..3, &["`sin` is a function", "found `x`", "write `sin(x)`"]),
        ("delay(x)", 0..8, &["`delay` takes 2 arguments, found 1", "write `delay(x, tau)`"]),
        ("sin()", 0..5, &["takes 1 argument, found 0"]),
        ("max(x, y, z)", 0..12, &["takes 2 arguments, found 3"]),
        ("sin'(x)", 0..4, &["has primes"]),
        ("(a + b", 0..1, &["never closed"]),
        ("sin(a", 3..4, &["never closed"]),
        ("a + b)", 5..6, &["found `)`", "remove it"]),
        ("()", 1..2, &["inside the parentheses"]),
        ("a +", 3..3, &["found the end, expected a number"]),
        ("", 0..0, &["found the end"]),
        ("a * / b", 4..5, &["found `/`, expected a number"]),
        ("1,5", 1..2, &["decimals are written with `.`"]),
        ("(1,5)", 2..3, &["decimals are written with `.`"]),
        ("1e999", 0..5, &["too large"]),
        ("1.2.3", 3..5, &["found `.3` after `1.2`"]),
        (".", 0..1, &["expected a number"]),
        ("a & b", 2..3, &["no conditions"]),
        ("[a]", 0..1, &["write `(`", "only a `table` has lists"]),
        ("a[1]", 1..2, &["found `[` after `a`", "only a `table` has lists"]),
        ("a]", 1..2, &["found `]`", "remove it"]),
        ("table(x)", 7..8, &["found `)`", "write `table(x, [k1, k2], [v1, v2])`"]),
        ("table(x, 1, 2)", 9..10, &["found `1`", "write `table("]),
        ("table(x, [0, 1])", 15..16, &["found `)`", "write `table("]),
        ("table(x, [0, 1], [a, b], c)", 23..24, &["found `,`", "write `table("]),
        ("table(x, [0, 1], [a, b]", 5..6, &["never closed"]),
        ("table(x, [0, 1", 9..10, &["never closed", "missing `]`"]),
        ("table(x, [0, 1), [a, b])", 14..15, &["found `)` after `1`"]),
        ("table(x, [], [])", 10..11, &["found `]`"]),
        (
            "table(x, [0, k], [a, b])",
            13..14,
            &["found `k`, expected a knot: a number", "divide the first argument"],
        ),
        ("table(x, [0, 2, -1], [a, b, c])", 16..18, &["`-1` is not larger", "increasing order"]),
        ("table(x, [0], [a])", 9..12, &["2 to 200 knots, found 1"]),
        ("table(x, [0, 1], [a, b, c])", 17..26, &["2 knots, but 3 values", "one value for each knot"]),
        ("table(x, [-1e308, 1e308], [a, b])", 0..33, &["reach too far"]),
        ("table + 1", 0..5, &["`table` is a function"]),
    ] {
        let error = parse(text).expect_err(text);
        for fragment in fragments {
            assert!(error.to_string().contains(fragment), "{text}: {error} lacks {fragment}");
        }
        assert_eq!(error.span, place, "{text}: {error}");
    }
    for (text, place, fragment) in [
        ("a + b", 5..5, "found none"),
        ("a == b", 3..4, "write a single `=`"),
        ("a = b = c", 6..7, "one equation per line"),
        ("= b", 0..1, "left side of the equation is empty"),
        ("a =", 2..3, "right side of the equation is empty"),
        ("a + = b", 4..4, "expected a number"),
        ("a = 2b", 5..6, "write `2*b`"),
    ] {
        let error = parse_equation(text).expect_err(text);
        assert!(error.to_string().contains(fragment), "{text}: {error} lacks {fragment}");
        assert_eq!(error.span, place, "{text}: {error}");
    }
}
