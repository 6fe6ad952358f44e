// Formulas of docstrings; without a network they stay as they are written.
document$.subscribe(() => {
  if (window.renderMathInElement) {
    renderMathInElement(document.body, {
      delimiters: [{ left: "\\(", right: "\\)", display: false }, { left: "\\[", right: "\\]", display: true }],
    });
  }
});
