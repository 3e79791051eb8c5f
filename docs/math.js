// Render the equations of a page with KaTeX, which is part of this site. Pages without equations load nothing.
(() => {
  const equations = document.querySelectorAll(".arithmatex");
  if (!equations.length) return;
  const katexFolder = new URL("vendor/katex/", document.currentScript.src);
  const style = document.createElement("link");
  style.rel = "stylesheet";
  style.href = new URL("katex.min.css", katexFolder);
  const script = document.createElement("script");
  script.src = new URL("katex.min.js", katexFolder);
  script.onload = () => {
    for (const equation of equations) {
      const displayMode = equation.tagName === "DIV";
      katex.render(equation.textContent.slice(2, -2), equation, { displayMode, throwOnError: false }); // \( \) or \[ \]
    }
  };
  document.head.append(style, script);
})();
