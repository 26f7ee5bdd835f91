//! The Python module `drivelink._core`.

/// What `drivelink._core` offers.
#[cfg(feature = "extension-module")]
#[pyo3::pymodule(name = "_core")]
mod extension {
    use pyo3::prelude::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
