//! Finds the physics a simulation leaves out.
