//! Sparse regression for identification: which of many candidate terms make up p ≈ Σ cⱼ aⱼ, and how sure is it.
//!
//! | module | what it answers |
//! |---|---|
//! | [`library`] | the candidate terms, nested by order, and their columns |
//! | [`design`], [`gram`] | checked columns; sums of products by blocks, least squares on any set of rows |
//! | [`mod@stlsq`], [`mod@lasso`], [`subset`] | sparse models along a path of thresholds, penalties or sizes |
//! | [`folds`], [`criteria`] | which rows validate; which order is enough |
//! | [`select`] | all of it together: thesis Algorithm 1 |
//! | [`mod@bootstrap`], [`covariance`] | spread of the coefficients, also for correlated rows |
//!
//! The README's example recovers a sparse cubic.
// A single range is a set of rows here, never a mistaken list of numbers.
#![allow(clippy::single_range_in_vec_init)]

pub mod bootstrap;
pub mod covariance;
pub mod criteria;
pub mod design;
mod error;
pub mod folds;
pub mod gram;
pub mod lasso;
mod least_squares;
pub mod library;
pub mod select;
pub mod stlsq;
pub mod subset;
pub use crate::bootstrap::{Bootstrap, Penalty, Resampling, bootstrap};
pub use crate::covariance::{Bandwidth, newey_west};
pub use crate::criteria::{Criterion, effective_rows};
pub use crate::design::{Design, count, slices};
pub use crate::error::SparseError;
pub use crate::folds::{Folds, Rule, Split};
pub use crate::gram::{Gram, Normalised, Sample};
pub use crate::lasso::{lasso, refit, soft_threshold, support};
pub use crate::least_squares::least_squares;
pub use crate::library::{Function, Library, Term};
pub use crate::select::{Options, OrderFit, PathPoint, Problem, Search, Selector, search, search_split};
pub use crate::stlsq::{Threshold, log_grid, stlsq};
pub use crate::subset::{backward, best_subsets};

#[doc = include_str!("../README.md")]
#[cfg(doctest)]
struct Readme;
