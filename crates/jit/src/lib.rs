//! Straight-line programs of floating-point operations, compiled to machine code at run time.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(all(target_arch = "x86_64", any(unix, windows)))]
mod assembler;
#[cfg(all(target_arch = "x86_64", any(unix, windows)))]
mod compile;
#[cfg(all(target_arch = "x86_64", any(unix, windows)))]
mod extent;
#[cfg(all(target_arch = "x86_64", any(unix, windows)))]
mod memory;
mod program;

#[cfg(all(target_arch = "x86_64", any(unix, windows)))]
#[path = "native.rs"]
mod code;
#[cfg(not(all(target_arch = "x86_64", any(unix, windows))))]
#[path = "absent.rs"]
mod code;

pub use code::{Tangents, Values};
pub use program::{Binary, Operand, Operation, Operations, Power, Row, Rule, Rules, Unary};
