"""The paper's experiments as studies."""
