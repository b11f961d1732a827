//! Reports of a diagnosis: JSON by contract, improved model, self-contained HTML.
