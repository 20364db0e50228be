-- why: a number for every class, in alphabetical order
-- reads: detections
-- params: none
-- writes: sign_class VARCHAR, class_code INTEGER
SELECT
    sign_class,
    (row_number() OVER (ORDER BY sign_class) - 1)::INTEGER AS class_code
FROM (SELECT DISTINCT sign_class FROM detections WHERE sign_class IS NOT NULL)
ORDER BY class_code
