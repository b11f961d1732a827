//! Expressions of the model language.
//!
//! An [`Expr`] is a plain syntax tree over *names*: whether `theta` is a state, an input or a
//! parameter is the business of the [`Model`](crate::Model) it stands in. A name carries its number
//! of primes (time derivatives): `theta''` is `Var { name: "theta", primes: 2 }`.

use std::sync::Arc;

/// A node of the syntax tree.
#[derive(Debug, Clone, PartialEq)]
pub enum Expr {
    /// A number, SI where it has a dimension.
    Num(f64),
    /// A name with its number of primes: state, input, parameter, `t` or `pi`.
    Var {
        /// The name without primes.
        name: Arc<str>,
        /// How many time derivatives are taken.
        primes: u8,
    },
    /// `-a`
    Neg(Box<Expr>),
    /// `a op b`
    Bin(BinOp, Box<Expr>, Box<Expr>),
    /// `f(a, …)` with as many arguments as [`Func::takes`].
    Call(Func, Vec<Expr>),
}

/// Binary operators, in rising order of precedence: `+ -`, `* /`, `^` (right associative).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BinOp {
    /// `a + b`
    Add,
    /// `a - b`
    Sub,
    /// `a * b`
    Mul,
    /// `a / b`
    Div,
    /// `a ^ b`
    Pow,
}

/// Functions of the model language.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Func {
    /// `sin(x)`
    Sin,
    /// `cos(x)`
    Cos,
    /// `tan(x)`
    Tan,
    /// `exp(x)`
    Exp,
    /// `ln(x)`
    Ln,
    /// `sqrt(x)`
    Sqrt,
    /// `tanh(x)`
    Tanh,
    /// `atan(x)`
    Atan,
    /// `abs(x)`
    Abs,
    /// `sign(x)`; `sign(0)` is set-valued, [−1, 1]: friction sticks.
    Sign,
    /// `min(a, b)`
    Min,
    /// `max(a, b)`
    Max,
    /// `delay(x, tau)` = x(t − tau); before the start x holds its initial value.
    Delay,
    /// `deadzone(x, gap)`: zero for |x| ≤ gap, x ∓ gap outside.
    Deadzone,
    /// `saturate(x, limit)`: x clipped to ±limit.
    Saturate,
    /// `step(t, t0)`: 0 for t < t0, 1 for t ≥ t0.
    Step,
    /// `table(x, [k1, …, kn], [v1, …, vn])`: linear between the knots, held beyond the first and the last; its arguments are
    /// x, the knots (increasing numbers) and the values, in this order. See [`Table`](crate::Table).
    Table,
}

impl Func {
    /// Every function of the language.
    pub const ALL: [Func; 17] = {
        use Func::*;
        [
            Sin, Cos, Tan, Exp, Ln, Sqrt, Tanh, Atan, Abs, Sign, Min, Max, Delay, Deadzone, Saturate, Step,
            Table,
        ]
    };

    /// The function of this name in the model language.
    pub fn from_name(name: &str) -> Option<Func> {
        use Func::*;
        Some(match name {
            "sin" => Sin,
            "cos" => Cos,
            "tan" => Tan,
            "exp" => Exp,
            "ln" => Ln,
            "sqrt" => Sqrt,
            "tanh" => Tanh,
            "atan" => Atan,
            "abs" => Abs,
            "sign" => Sign,
            "min" => Min,
            "max" => Max,
            "delay" => Delay,
            "deadzone" => Deadzone,
            "saturate" => Saturate,
            "step" => Step,
            "table" => Table,
            _ => return None,
        })
    }

    /// Its name in the model language.
    pub fn name(self) -> &'static str {
        use Func::*;
        match self {
            Sin => "sin",
            Cos => "cos",
            Tan => "tan",
            Exp => "exp",
            Ln => "ln",
            Sqrt => "sqrt",
            Tanh => "tanh",
            Atan => "atan",
            Abs => "abs",
            Sign => "sign",
            Min => "min",
            Max => "max",
            Delay => "delay",
            Deadzone => "deadzone",
            Saturate => "saturate",
            Step => "step",
            Table => "table",
        }
    }

    /// Number of arguments; `None` where it varies (a table of n knots has 1 + 2n).
    pub fn arity(self) -> Option<usize> {
        use Func::*;
        match self {
            Sin | Cos | Tan | Exp | Ln | Sqrt | Tanh | Atan | Abs | Sign => Some(1),
            Min | Max | Delay | Deadzone | Saturate | Step => Some(2),
            Table => None,
        }
    }
}

impl Expr {
    /// A name without primes.
    pub fn var(name: &str) -> Expr {
        Expr::Var { name: name.into(), primes: 0 }
    }

    /// A name with `primes` time derivatives.
    pub fn prime(name: &str, primes: u8) -> Expr {
        Expr::Var { name: name.into(), primes }
    }

    /// `f(args)`
    pub fn call(f: Func, args: Vec<Expr>) -> Expr {
        Expr::Call(f, args)
    }

    /// `self ^ e`
    pub fn pow(self, e: Expr) -> Expr {
        Expr::Bin(BinOp::Pow, Box::new(self), Box::new(e))
    }

    /// Calls `f` on this node and every node below it.
    pub fn walk(&self, f: &mut impl FnMut(&Expr)) {
        f(self);
        match self {
            Expr::Num(_) | Expr::Var { .. } => {}
            Expr::Neg(a) => a.walk(f),
            Expr::Bin(_, a, b) => {
                a.walk(f);
                b.walk(f);
            }
            Expr::Call(_, args) => args.iter().for_each(|a| a.walk(f)),
        }
    }

    /// The tree with every node rebuilt bottom-up by `f`.
    pub fn map(&self, f: &mut impl FnMut(Expr) -> Expr) -> Expr {
        let rebuilt = match self {
            Expr::Num(_) | Expr::Var { .. } => self.clone(),
            Expr::Neg(a) => Expr::Neg(Box::new(a.map(f))),
            Expr::Bin(op, a, b) => Expr::Bin(*op, Box::new(a.map(f)), Box::new(b.map(f))),
            Expr::Call(g, args) => Expr::Call(*g, args.iter().map(|a| a.map(f)).collect()),
        };
        f(rebuilt)
    }

    /// Whether `name` occurs, with any number of primes.
    pub fn mentions(&self, wanted: &str) -> bool {
        let mut found = false;
        self.walk(&mut |e| {
            if let Expr::Var { name, .. } = e {
                found |= &**name == wanted;
            }
        });
        found
    }
}

macro_rules! binary {
    ($trait:ident, $method:ident, $op:ident) => {
        impl std::ops::$trait for Expr {
            type Output = Expr;
            fn $method(self, other: Expr) -> Expr {
                Expr::Bin(BinOp::$op, Box::new(self), Box::new(other))
            }
        }
    };
}
binary!(Add, add, Add);
binary!(Sub, sub, Sub);
binary!(Mul, mul, Mul);
binary!(Div, div, Div);

impl std::ops::Neg for Expr {
    type Output = Expr;
    fn neg(self) -> Expr {
        Expr::Neg(Box::new(self))
    }
}

impl From<f64> for Expr {
    fn from(v: f64) -> Expr {
        Expr::Num(v)
    }
}
