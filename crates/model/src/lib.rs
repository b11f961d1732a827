//! The greybox model language: textbook equations, parsed, checked for units and compiled.
pub mod algebra;
mod dimension;
mod display;
mod edit;
pub mod error;
pub mod expr;
mod load;
pub mod model;
mod nearest;
pub mod parse;
pub mod units;
mod write;

pub use error::{ModelError, Place, Problem};
pub use expr::{BinOp, Expr, Func};
pub use model::{Equation, Hold, Input, Measurement, Model, Parameter, State};
pub use parse::{Parsed, ParsedEquation, SyntaxError, parse, parse_equation};
pub use units::{Dimension, Unit, UnitError};
pub use write::WriteOptions;
