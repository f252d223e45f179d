// Returns elements of the page, and their texts, by their ids.

export const element = (name) => document.getElementById(name);
export const elementText = (name) => element(name).textContent;
