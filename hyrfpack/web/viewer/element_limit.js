// Limits the number of scenes that the elements <hyrf-viewer> of a page draw, because browsers take graphics contexts
// away from pages that have more than about 16. Elements in the window come first, then those near it, then those that
// left it last.

export const MAX_SCENES = 12; // leaves some contexts for other scripts of the page
const NEAR_MARGIN = "300px";

const views = new Set(); // the InlineViews of the page; those that came or left last are at the end
let observers = null; // created late, because the package is also imported without a browser

// Adds a view, whose fields `isNear` and `isVisible` say from now on where its element is.
export function addView(view) {
  observers ??= [makeObserver("isNear", NEAR_MARGIN), makeObserver("isVisible", "0px")];
  view.isNear = view.isVisible = false;
  views.add(view);
  for (const observer of observers) observer.observe(view.element);
}

// Removes a view, whose place another one may take.
export function removeView(view) {
  views.delete(view);
  for (const observer of observers) observer.unobserve(view.element);
  assignScenes();
}

// Returns an observer that keeps a field of views up to date: whether their element is in the window and its margin.
function makeObserver(field, rootMargin) {
  const follow = (entries) => {
    for (const { target, isIntersecting } of entries) {
      const view = [...views].find(({ element }) => element === target);
      if (!view) continue;
      if (view.isLost && isIntersecting && !view.isVisible) view.suspend(); // a new viewer gets another context
      view[field] = isIntersecting;
      views.delete(view);
      views.add(view);
    }
    assignScenes();
  };
  return new IntersectionObserver(follow, { rootMargin });
}

// Returns how near the window a view is: 2 in it, 1 near it, 0 elsewhere.
const rankOf = ({ isVisible, isNear }) => Number(isVisible) + Number(isNear);
// Returns whether a view has a viewer, or waits for one that it may have now.
const wantsViewer = (view) => view.viewer || (view.isPending && (view.isNear || view.isEager));

// Opens the views that come first, and closes the others.
export function assignScenes() {
  const candidates = [...views].reverse().filter(wantsViewer);
  candidates.sort((a, b) => rankOf(b) - rankOf(a) || Boolean(b.viewer) - Boolean(a.viewer));
  for (const view of candidates.slice(MAX_SCENES)) view.suspend(); // before others open, so that the limit always holds
  for (const view of candidates.slice(0, MAX_SCENES)) view.open();
}

// Handles the loss of a view's context. The browser restores one that it took away once there is room for it.
export function handleLostContext(view) {
  const isFar = (other) => other.viewer && !other.isNear;
  if (isFar(view)) view.suspend();
  else [...views].find(isFar)?.suspend();
}
