#![doc = include_str!("../README.md")]

pub mod bootstrap;
pub mod covariance;
pub mod criteria;
pub mod error;
pub mod folds;
pub mod gram;
pub mod lasso;
pub mod library;
mod product;
mod protect;
pub mod rows;
pub mod select;
pub mod stlsq;
pub mod subset;
#[cfg(test)]
mod testing;
pub mod triangle;

pub use bootstrap::{Bootstrap, BootstrapOptions, Penalty, Resample, bootstrap, stability};
pub use covariance::{Covariance, covariance};
pub use criteria::Criterion;
pub use error::SparseError;
pub use folds::Split;
pub use gram::{BlockGram, Gram};
pub use library::{Function, Library, Term};
pub use rows::Rows;
pub use select::{FoldKind, Options, OrderModel, Problem, Rule, SampleSize, Search, Selector, search};
pub use triangle::{Fit, Triangle};
