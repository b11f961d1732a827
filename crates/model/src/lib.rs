//! The greybox model language: differential equations as a textbook writes them, in TOML; parsed,
//! checked, differentiated, edited and written back.
//!
//! ```
//! use greybox_model::{Model, WriteOptions, parse};
//!
//! let text = r#"
//! name = "Rotary flexible link, linear nominal"
//!
//! [inputs]
//! v = { unit = "V", hold = "linear" }      # hold: zero | linear | band_limited
//!
//! [states]
//! theta = { unit = "rad" }                 # measured by the channel of the same name
//! alpha = { unit = "rad", channel = "alpha" }
//!
//! [parameters]
//! J  = { value = 0.0021, unit = "kg m^2", std = 0.0002 }  # std: prior 1-sigma
//! Jl = { value = 0.0019, unit = "kg m^2" }
//! B  = { value = 0.004, unit = "N m s/rad" }
//! Bl = { value = 0.0001 }                  # the equations imply N m s
//! ks = { value = 1.3, unit = "N m/rad" }
//! kt = { value = 0.50, unit = "N m/V", fixed = true }     # known exactly: never moved
//!
//! [equations]
//! hub  = "J*theta'' + B*theta' - ks*alpha = kt*v"
//! link = "Jl*(theta'' + alpha'') + Bl*alpha' + ks*alpha = 0"
//! "#;
//! let mut model = Model::from_toml(text, "link.toml")?;
//! assert_eq!(model.states[0].order, 2);
//!
//! // Equations are affine in the highest derivatives: the mass matrix's row of `link`, and the rest.
//! let highest = [("theta", 2), ("alpha", 2)];
//! let (row, rest) = model.equations[1].residual().affine_in(&highest).ok_or("not affine")?;
//! assert_eq!((row[0].to_string(), row[1].to_string()), ("Jl".into(), "Jl".into()));
//! assert_eq!(rest.derivative("alpha", 1).to_string(), "Bl");
//!
//! // What a diagnosis adds is the same language again.
//! let friction = parse("fc*sign(theta')")?.expr;
//! model.parameters.push(greybox_model::Parameter {
//!     name: "fc".into(), value: 0.11, unit: None, std: None, fixed: false, positive: None,
//! });
//! model.add_term(0, friction);
//! model.resolve_units()?;
//! let improved = model.to_toml(&WriteOptions { original: Some(text), ..Default::default() });
//! assert!(improved.contains("fc = { value = 0.11, unit = \"N m\" }"));
//! assert!(improved.contains("hub  = \"J*theta'' + B*theta' - ks*alpha + fc*sign(theta') = kt*v\""));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # The file
//! | table | entry | keys |
//! |---|---|---|
//! | | `name = "…"` | |
//! | `[units]` | `enc = "2*pi/4096 rad"` | a multiple of a known unit, or `"own"`: a dimension of its own |
//! | `[inputs]` | `u = { … }` | `unit`, `hold`, `channel` |
//! | `[states]` | `x = { … }` | `unit`, `channel`, `measured`, `initial` (x or [x, x', …], in its unit) |
//! | `[parameters]` | `k = { … }` | `value`, `unit`, `std`, `fixed` |
//! | `[equations]` | `name = "lhs = rhs"` | as many as states, affine in the highest derivatives |
//! | `[measurements]` | `channel = "expression"` | or `{ expression = "…", unit = "…" }` |
//!
//! Values are SI once loaded; [`Unit`] keeps how the user wrote them. A unit that is not stated is
//! inferred from the equations. A measurement named after a state's channel takes the place of the
//! state's own.
//!
//! # The grammar of expressions
//! See [`parse`](mod@parse) for the grammar, [`Func`] for the functions, [`units`] for units. `t` is
//! the time since the start of the recording, `pi` the constant.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

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
pub mod system;
pub mod table;
pub mod tape;
pub mod units;
mod write;

pub use error::{ModelError, Place, Problem};
pub use expr::{BinOp, Expr, Func};
pub use model::{Equation, Hold, Input, Measurement, Model, Parameter, State};
pub use nearest::nearest;
pub use parse::{Parsed, ParsedEquation, SyntaxError, parse, parse_equation};
pub use system::System;
pub use table::Table;
pub use units::{DeclaredUnit, Dimension, Unit, UnitError, Units};
pub use write::WriteOptions;
