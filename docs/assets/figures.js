// Draws the figures of executed notebooks when they come into view. Plotly is a file of the site beside this one.
(function () {
  function draw(box) {
    const figure = JSON.parse(box.querySelector("script").textContent);
    box.replaceChildren();
    window.Plotly.newPlot(box, figure.data, figure.layout, { responsive: true, displaylogo: false });
  }
  function begin() {
    const seen = new IntersectionObserver(
      function (entries) {
        for (const entry of entries) {
          if (entry.isIntersecting) {
            seen.unobserve(entry.target);
            draw(entry.target);
          }
        }
      },
      { rootMargin: "400px" },
    );
    document.querySelectorAll(".plotly-figure").forEach((box) => seen.observe(box));
  }
  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", begin);
  else begin();
})();
