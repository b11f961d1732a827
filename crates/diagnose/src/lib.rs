//! Finds the physics a simulation leaves out.
pub mod along;
pub mod candidate;
pub mod library;
pub mod place;
pub mod screen;
