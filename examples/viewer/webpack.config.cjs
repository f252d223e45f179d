// Bundles main.jsx by webpack: npx webpack

module.exports = {
  mode: "production",
  entry: "./main.jsx",
  resolve: { extensions: [".jsx", ".js"] },
  module: {
    rules: [{ test: /\.jsx$/, loader: "esbuild-loader", options: { jsx: "automatic", target: "es2022" } }],
  },
};
