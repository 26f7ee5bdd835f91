//! Errors of the declared model, one line each, raised when an estimator is made; a tick has no errors.

use std::fmt;

/// What was wrong, where, and what was expected.
#[derive(Clone, Debug, PartialEq)]
pub struct Error(pub String);

impl fmt::Display for Error {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

impl std::error::Error for Error {}
