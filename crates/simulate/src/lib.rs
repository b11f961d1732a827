//! Simulation of greybox models: events, stick-slip, delays, forward sensitivities.
