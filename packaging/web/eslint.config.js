// The page's modules run in browsers alone.
import js from "@eslint/js";
import globals from "globals";

export default [
  js.configs.recommended,
  {
    languageOptions: { ecmaVersion: "latest", sourceType: "module", globals: globals.browser },
    rules: {
      "max-statements-per-line": ["error", { max: 1 }],
      "no-sequences": "error",
      "one-var": ["error", "never"],
      curly: "error",
      "prefer-const": "error",
      eqeqeq: "error",
    },
  },
];
