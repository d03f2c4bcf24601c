//! The joint filter, the smoother, and the paper's estimator.
