// Access to the elements of the page by their ids.

export const element = (name) => document.getElementById(name);
export const elementText = (name) => element(name).textContent;
