// What the page's document holds, by its names.

export const element = (name) => document.getElementById(name);
export const textOf = (name) => element(name).textContent;
