// What scrolls sideways can be reached and scrolled with the keyboard, and says what it is.
"use strict";
(function () {
  const WIDE = ".table-wrapper, .cell_output, article pre, mjx-container[display='true']";
  const NAMES = { DIV: "table or figure", PRE: "code or output", "MJX-CONTAINER": "formula" };

  function reach() {
    for (const box of document.querySelectorAll(WIDE)) {
      if (box.scrollWidth <= box.clientWidth + 1 || box.hasAttribute("tabindex")) continue;
      box.tabIndex = 0;
      if (box.tagName === "MJX-CONTAINER") continue; // it has a role already
      box.setAttribute("role", "region");
      box.setAttribute("aria-label", "wide " + NAMES[box.tagName] + ", scrolls sideways");
    }
  }

  window.addEventListener("load", function () {
    reach();
    if (window.MathJax && window.MathJax.startup) window.MathJax.startup.promise.then(reach);
  });
  window.addEventListener("resize", reach);
})();
