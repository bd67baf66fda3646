// Before the first paint, so that the page never flashes in the wrong colours.
const preferred = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
document.documentElement.dataset.theme = localStorage.getItem("mems6dof-theme") ?? preferred;
