//! What is wrong with a function or a model that is to be written.

use greybox_model::system::CompileError;

/// Why a function cannot be written as code.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// A symbol is neither an argument nor a constant.
    #[error("output {output} uses `{symbol}`, which is neither an argument nor a constant of the function")]
    Unknown {
        /// Which output.
        output: String,
        /// The symbol, with primes.
        symbol: String,
    },
    /// A function of the model language that has no value at one instant.
    #[error("output {output} uses `{function}`, which depends on time: a law must not; leave the term out")]
    Time {
        /// Which output.
        output: String,
        /// Its name.
        function: &'static str,
    },
    /// A number that code cannot hold.
    #[error("`{name}` is {value}: a constant must be a finite number")]
    NotFinite {
        /// Constant, or the output that has the number.
        name: String,
        /// The number.
        value: f64,
    },
    /// A name that is no name in C and Rust.
    #[error(
        "`{name}` cannot be the name of a function or an argument: start with a letter, go on with letters, digits and _, and avoid keywords"
    )]
    Name {
        /// The name.
        name: String,
    },
    /// Two things of one name.
    #[error("`{name}` is given twice")]
    Twice {
        /// The name.
        name: String,
    },
    /// A model that does not compile.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// A model that a language cannot hold as it stands.
    #[error("equation \"{equation}\": `{function}` cannot be written in {language}: {reason}; help: {help}")]
    Refused {
        /// Name of the equation.
        equation: String,
        /// Function of the model language.
        function: &'static str,
        /// Language to write.
        language: &'static str,
        /// Why not.
        reason: &'static str,
        /// What to do.
        help: &'static str,
    },
}
