//! The greybox model language: textbook equations, parsed, checked for units and compiled.
pub mod expr;
pub mod model;
pub mod units;

pub use expr::{BinOp, Expr, Func};
pub use model::{Equation, Hold, Input, Measurement, Model, Parameter, State};
pub use units::{Dimension, Unit};
