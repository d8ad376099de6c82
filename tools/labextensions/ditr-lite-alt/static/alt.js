/* JupyterLab keeps a figure's alternative text in its cell's metadata, under "alt", but does not hand it to the picture.
   This does. It is loaded as JupyterLab loads any prebuilt extension, as a container of modules, and needs no build. */
(() => {
  const NAME = "ditr-lite-alt";
  const PICTURES = ".jp-OutputArea img:not([alt]), .jp-OutputArea .js-plotly-plot:not([aria-label])";

  /** Return the "alt" of the notebook cell that shows an element, or undefined. */
  function words(app, element) {
    for (const panel of app.shell.widgets("main")) {
      const cell = panel.content?.widgets?.find((c) => c.model && c.node.contains(element));
      if (cell) return cell.model.getMetadata("alt");
    }
  }

  function describe(app) {
    for (const picture of document.querySelectorAll(PICTURES)) {
      const alt = words(app, picture);
      if (!alt) continue;
      if (picture.tagName === "IMG") picture.alt = alt;
      else {
        picture.setAttribute("role", "figure");
        picture.setAttribute("aria-label", alt);
      }
    }
  }

  function activate(app) {
    let waiting = false;
    const later = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => {
        waiting = false;
        describe(app);
      });
    };
    new MutationObserver(later).observe(document.body, { childList: true, subtree: true });
  }

  const plugin = { id: NAME + ":plugin", autoStart: true, activate };
  globalThis._JUPYTERLAB = globalThis._JUPYTERLAB ?? {};
  globalThis._JUPYTERLAB[NAME] = { init() {}, get: async () => () => ({ __esModule: true, default: plugin }) };
})();
